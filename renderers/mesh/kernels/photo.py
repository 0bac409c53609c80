"""What the camera's electronics make of a colour: saturation and contrast, noise, bytes."""

from ...engine import ti
from ..tables import BIAS, DEVELOPED, MATRIX, NOISE
from .lanes import LANES, SHIFT, whole
from .raster import high, low

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
    bits = ti.bit_cast(low(high(value, f32(0.0)), f32(1.0)) * f32(255.0) + f32(8388608.0), i32)
    return bits & i32(255)


@ti.func
def develop(pixel: i32, out: i32, count: i32, light, seed: i64, some: ti.template(), image: ti.template(),
            image_words: ti.template()):  # fmt: skip
    """Colours to the bytes of ``count`` pixels from ``out`` of all, which is ``pixel`` of its image."""
    if light[DEVELOPED] != 0:
        for i in range(i32(LANES)):
            r, g, b = some.red[i], some.green[i], some.blue[i]
            some.red[i] = light[MATRIX] * r + light[MATRIX + 1] * g + light[MATRIX + 2] * b + light[BIAS]
            some.green[i] = light[MATRIX + 3] * r + light[MATRIX + 4] * g + light[MATRIX + 5] * b + light[BIAS]
            some.blue[i] = light[MATRIX + 6] * r + light[MATRIX + 7] * g + light[MATRIX + 8] * b + light[BIAS]
    if light[NOISE] > 0:
        for i in range(i32(LANES)):
            bits = scatter(seed, pixel + i)
            some.red[i] = some.red[i] + light[NOISE] * bell(bits)
            some.green[i] = some.green[i] + light[NOISE] * bell(bits >> 21)
            some.blue[i] = some.blue[i] + light[NOISE] * bell(bits >> 42)
    colours = whole(0)
    for i in range(i32(LANES)):
        colours[i] = byte(some.red[i]) | (byte(some.green[i]) << 8) | (byte(some.blue[i]) << 16)
    if count == LANES:
        for eight in ti.static(range(LANES // 8)):
            c = [ti.cast(colours[8 * eight + i], u64) for i in range(8)]
            at = (out >> SHIFT) * (LANES * 3 // 8) + 3 * eight
            image_words[at] = c[0] | (c[1] << 24) | (c[2] << 48)
            image_words[at + 1] = (c[2] >> 16) | (c[3] << 8) | (c[4] << 32) | (c[5] << 56)
            image_words[at + 2] = (c[5] >> 8) | (c[6] << 16) | (c[7] << 40)
    else:
        for i in range(count):
            for channel in ti.static(range(3)):
                image[3 * (out + i) + channel] = ti.cast(colours[i] >> (8 * channel), ti.u8)
