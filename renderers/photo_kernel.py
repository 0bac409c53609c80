"""What the camera's electronics make of a colour: saturation and contrast, noise, bytes."""

from probscene.renderers.engine import ti
from probscene.renderers.mesh_tables import BIAS, DEVELOPED, MATRIX, NOISE
from probscene.renderers.raster_kernel import high, low

i32, i64, u32, u64, f32 = ti.i32, ti.i64, ti.u32, ti.u64, ti.f32


@ti.func
def scatter(seed: i64, pixel: i32):
    """64 bits of an image's pixel (a mix after Steele, Lea and Flood 2014)."""
    x = ti.cast(seed, u64) * u64(0x1E3779B97F4A7C15) + ti.cast(pixel, u64) * u64(0x3C6EF372FE94F82B)
    x = (x ^ (x >> 30)) * u64(0x3F58476D1CE4E5B9)
    x = (x ^ (x >> 27)) * u64(0x14D049BB133111EB)
    return x ^ (x >> 31)


@ti.func
def bell(bits: u64):
    """About normal, of mean 0 and variance 1: three of seven bits added up."""
    total = (bits & 127) + ((bits >> 7) & 127) + ((bits >> 14) & 127)
    return (ti.cast(ti.cast(total, i32), f32) - f32(190.5)) * f32(0.015625)


@ti.func
def byte(value: f32):
    """The nearest whole number of 255ths, by the lowest bits of a number that has no smaller ones."""
    bits = ti.bit_cast(low(high(value, f32(0.0)), f32(1.0)) * f32(255.0) + f32(8388608.0), u32)
    return ti.cast(bits & 255, ti.u8)


@ti.func
def develop(pixel: i32, out: i32, r: f32, g: f32, b: f32, light, seed: i64, image: ti.template()):
    """A colour to the bytes of pixel ``out`` of all, which is ``pixel`` of its image."""
    red, green, blue = r, g, b
    if light[DEVELOPED] != 0:
        red = light[MATRIX] * r + light[MATRIX + 1] * g + light[MATRIX + 2] * b + light[BIAS]
        green = light[MATRIX + 3] * r + light[MATRIX + 4] * g + light[MATRIX + 5] * b + light[BIAS]
        blue = light[MATRIX + 6] * r + light[MATRIX + 7] * g + light[MATRIX + 8] * b + light[BIAS]
    if light[NOISE] > 0:
        bits = scatter(seed, pixel)
        red, green = red + light[NOISE] * bell(bits), green + light[NOISE] * bell(bits >> 21)
        blue += light[NOISE] * bell(bits >> 42)
    image[3 * out], image[3 * out + 1], image[3 * out + 2] = byte(red), byte(green), byte(blue)


@ti.func
def put(
    x: i32, pixel: i32, out: i32, red: f32, green: f32, blue: f32, share: f32, light, seed: i64, line_base: i32,
    tap: ti.template(), line: ti.template(), image: ti.template(),
):  # fmt: skip
    """A colour of column ``x`` to the image, or a share of it to the colours that wait in ``line``."""
    if ti.static(tap):
        p = line_base + 3 * x
        line[p], line[p + 1] = line[p] + red * share, line[p + 1] + green * share
        line[p + 2] = line[p + 2] + blue * share
    else:
        develop(pixel + x, out + x, red, green, blue, light, seed, image)
