"""A Gaussian over an image: down its columns into a line of scratch, and from there along the row."""

from ..engine import ti
from .tone import byte

i32, f32 = ti.i32, ti.f32


@ti.real_func
def spread(at: i32, count: i32, image: ti.types.ndarray(ti.u8, 1), to: i32, scratch: ti.types.ndarray(f32, 1)):
    """Bytes into scratch."""
    for i in range(count):
        scratch[to + i] = ti.cast(image[at + i], f32)


@ti.real_func
def weigh(to: i32, one: i32, other: i32, count: i32, weight: f32, scratch: ti.types.ndarray(f32, 1)):
    """A first term: two lines, which may be one, times a weight."""
    for i in range(count):
        scratch[to + i] = weight * (scratch[one + i] + scratch[other + i])


@ti.real_func
def add(to: i32, one: i32, other: i32, count: i32, weight: f32, scratch: ti.types.ndarray(f32, 1)):
    """Another term."""
    for i in range(count):
        scratch[to + i] = scratch[to + i] + weight * (scratch[one + i] + scratch[other + i])


@ti.real_func
def gather(at: i32, count: i32, image: ti.types.ndarray(ti.u8, 1), line: i32, scratch: ti.types.ndarray(f32, 1)):
    """Scratch, 0..255, into bytes."""
    for i in range(count):
        image[at + i] = ti.cast(byte(scratch[line + i] * f32(1 / 255)), ti.u8)


@ti.func
def blur(
    first: i32, height: i32, width: i32, radius: i32, weights_base: i32, base: i32, weights: ti.template(),
    image: ti.template(), scratch: ti.template(),
):  # fmt: skip
    """Blur the image whose first pixel is ``first`` of all; ``weights`` from the middle to ``radius``.

    The scratch holds the image, a row that goes on for ``radius`` pixels on either side, and a row.
    """
    line, edge = i32(3) * width, i32(3) * radius
    wide = base + height * line
    row_at, done = wide + edge, wide + line + edge + edge
    start = i32(3) * first
    spread(start, height * line, image, base, scratch)
    for row in range(height):
        weigh(row_at, base + row * line, base + row * line, line, weights[weights_base], scratch)
        for k in range(i32(1), radius + i32(1)):
            above = base + ti.max(row - k, i32(0)) * line
            below = base + ti.min(row + k, height - i32(1)) * line
            add(row_at, above, below, line, weights[weights_base + k], scratch)
        for k in range(i32(1), radius + i32(1)):
            for channel in ti.static(range(3)):
                scratch[row_at - 3 * k + channel] = scratch[row_at + channel]
                scratch[row_at + line + 3 * (k - 1) + channel] = scratch[row_at + line - 3 + channel]
        weigh(done, row_at, row_at, line, weights[weights_base], scratch)
        for k in range(i32(1), radius + i32(1)):
            add(done, row_at - i32(3) * k, row_at + i32(3) * k, line, weights[weights_base + k], scratch)
        gather(start + row * line, line, image, done, scratch)
