"""Camera effects on colours, pixel by pixel: vignette, exposure, gains, saturation and contrast, noise, bytes."""

from ..engine import ti
from .lanes import LANES, SHIFT, floats, high, low, whole

# Columns of the table of effects, one row a scene, float64: whether colours change, by what 3 x 3 matrix and bias, what
# is missing a square pixel from the middle, where that is; noise before the blur and after it, of 1; radius of the
# blur, pixels; whether there is JPEG.
TONED, MATRIX, BIAS, VIGNETTE, MIDDLE_U, MIDDLE_V, NOISE, LATER, RADIUS, JPEG, NUM_COLUMNS = (
    0,
    1,
    10,
    11,
    12,
    13,
    14,
    15,
    16,
    17,
    18,
)

i32, i64, u32, u64, f32 = ti.i32, ti.i64, ti.u32, ti.u64, ti.f32


@ti.dataclass
class Colours:
    """``LANES`` pixels, 0..1."""

    red: floats
    green: floats
    blue: floats


@ti.func
def tone_of(scene: i32, photos: ti.template()):
    """A scene's row of the table of effects, in registers."""
    return ti.Vector([ti.cast(photos[scene * NUM_COLUMNS + i], f32) for i in range(NUM_COLUMNS)], dt=f32)


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
def read_bytes(out: i32, count: i32, some: ti.template(), image: ti.template(), image_words: ti.template()):
    """The colours of ``count`` pixels from ``out`` of all; of ``LANES`` where a block begins."""
    colours = whole(0)
    if count == LANES:
        for eight in ti.static(range(LANES // 8)):
            at = (out >> SHIFT) * (LANES * 3 // 8) + 3 * eight
            a, b, c = image_words[at], image_words[at + 1], image_words[at + 2]
            each = [a, a >> 24, (a >> 48) | (b << 16), b >> 8, b >> 32, (b >> 56) | (c << 8), c >> 16, c >> 40]
            for i in ti.static(range(8)):
                colours[8 * eight + i] = ti.cast(ti.cast(each[i], u32), i32)
    else:
        for i in range(count):
            for channel in ti.static(range(3)):
                colours[i] = colours[i] | (ti.cast(image[3 * (out + i) + channel], i32) << (8 * channel))
    for i in range(i32(LANES)):
        some.red[i] = ti.cast(colours[i] & 255, f32) * f32(1 / 255)
        some.green[i] = ti.cast((colours[i] >> 8) & 255, f32) * f32(1 / 255)
        some.blue[i] = ti.cast((colours[i] >> 16) & 255, f32) * f32(1 / 255)


@ti.func
def write_bytes(out: i32, count: i32, some: ti.template(), image: ti.template(), image_words: ti.template()):
    """Colours to the bytes of ``count`` pixels from ``out`` of all; of ``LANES`` where a block begins."""
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


@ti.func
def develop(
    column: i32, row: i32, pixel: i32, out: i32, count: i32, toned: f32, noise: f32, photo, seed: i64,
    some: ti.template(), image: ti.template(), image_words: ti.template(),
):  # fmt: skip
    """Colours to the bytes of ``count`` pixels of a row, from ``out`` of all, which is ``pixel`` of its image."""
    if toned != 0:
        down = ti.cast(row, f32) - photo[MIDDLE_V]
        for i in range(i32(LANES)):
            across = ti.cast(column + i, f32) - photo[MIDDLE_U]
            left = f32(1.0) - photo[VIGNETTE] * (across * across + down * down)
            r, g, b = some.red[i] * left, some.green[i] * left, some.blue[i] * left
            some.red[i] = photo[MATRIX] * r + photo[MATRIX + 1] * g + photo[MATRIX + 2] * b + photo[BIAS]
            some.green[i] = photo[MATRIX + 3] * r + photo[MATRIX + 4] * g + photo[MATRIX + 5] * b + photo[BIAS]
            some.blue[i] = photo[MATRIX + 6] * r + photo[MATRIX + 7] * g + photo[MATRIX + 8] * b + photo[BIAS]
    if noise > 0:
        for i in range(i32(LANES)):
            bits = scatter(seed, pixel + i)
            some.red[i] = some.red[i] + noise * bell(bits)
            some.green[i] = some.green[i] + noise * bell(bits >> 21)
            some.blue[i] = some.blue[i] + noise * bell(bits >> 42)
    write_bytes(out, count, some, image, image_words)
