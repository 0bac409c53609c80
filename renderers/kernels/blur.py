"""A Gaussian over an image, down its columns into scratch and from there along its rows."""

from ..engine import ti
from .lanes import LANES, floats
from .tone import byte

i32, f32 = ti.i32, ti.f32


@ti.func
def blur(
    first: i32, height: i32, width: i32, radius: i32, weights_base: i32, scratch_base: i32, weights: ti.template(),
    image: ti.template(), scratch: ti.template(),
):  # fmt: skip
    """Blur the image whose first pixel is ``first`` of all; ``weights`` from the middle to ``radius``.

    The scratch holds its rows, continued by ``radius`` pixels on either side.
    """
    line, start = 3 * width, 3 * first
    stride = line + 6 * radius
    for row in range(height):
        x, to = i32(0), scratch_base + row * stride + 3 * radius
        while x < line:
            count = ti.min(line - x, i32(LANES))
            total = floats(0)
            for k in range(radius + 1):
                above = start + ti.max(row - k, 0) * line + x
                below = start + ti.min(row + k, height - 1) * line + x
                weight = weights[weights_base + k]
                if count == LANES:
                    for i in range(i32(LANES)):
                        pair = ti.cast(image[above + i], i32) + ti.cast(image[below + i], i32)
                        total[i] = total[i] + weight * ti.cast(pair, f32)
                else:
                    for i in range(count):
                        pair = ti.cast(image[above + i], i32) + ti.cast(image[below + i], i32)
                        total[i] = total[i] + weight * ti.cast(pair, f32)
            for i in range(count):
                scratch[to + x + i] = total[i]
            x += i32(LANES)
        for k in range(1, radius + 1):
            for channel in ti.static(range(3)):
                scratch[to - 3 * k + channel] = scratch[to + channel]
                scratch[to + line + 3 * (k - 1) + channel] = scratch[to + line - 3 + channel]
    for row in range(height):
        x, at = i32(0), scratch_base + row * stride + 3 * radius
        while x < line:
            count = ti.min(line - x, i32(LANES))
            total = floats(0)
            for k in range(radius + 1):
                weight = weights[weights_base + k]
                for i in range(i32(LANES)):
                    pair = scratch[at + x + i - 3 * k] + scratch[at + x + i + 3 * k]
                    total[i] = total[i] + weight * pair
            for i in range(count):
                image[start + row * line + x + i] = ti.cast(byte(total[i] * f32(1 / 255)), ti.u8)
            x += i32(LANES)
