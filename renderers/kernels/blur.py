"""A Gaussian over an image: down its columns into a line of scratch, and from there along the row."""

from ..engine import ti
from .tone import byte

i32, f32 = ti.i32, ti.f32


@ti.real_func
def blur(
    first: i32, height: i32, width: i32, radius: i32, weights_base: i32, base: i32, weights: ti.types.ndarray(f32, 1),
    image: ti.types.ndarray(ti.u8, 1), scratch: ti.types.ndarray(f32, 1),
):  # fmt: skip
    """Blur the image whose first pixel is ``first`` of all; ``weights`` from the middle to ``radius``.

    The scratch holds the image, a row that goes on for ``radius`` pixels on either side, and a row.
    """
    line, edge, start = i32(3) * width, i32(3) * radius, i32(3) * first
    wide = base + height * line
    row_at, done = wide + edge, wide + line + edge + edge
    for i in range(height * line):
        scratch[base + i] = ti.cast(image[start + i], f32)
    for row in range(height):
        here, weight = base + row * line, weights[weights_base]
        for i in range(line):
            scratch[row_at + i] = weight * (scratch[here + i] + scratch[here + i])
        for k in range(i32(1), radius + i32(1)):
            above, below = base + ti.max(row - k, i32(0)) * line, base + ti.min(row + k, height - i32(1)) * line
            weight = weights[weights_base + k]
            for i in range(line):
                scratch[row_at + i] = scratch[row_at + i] + weight * (scratch[above + i] + scratch[below + i])
        for k in range(i32(1), radius + i32(1)):
            for channel in range(i32(3)):
                scratch[row_at - 3 * k + channel] = scratch[row_at + channel]
                scratch[row_at + line + 3 * (k - 1) + channel] = scratch[row_at + line - 3 + channel]
        weight = weights[weights_base]
        for i in range(line):
            scratch[done + i] = weight * (scratch[row_at + i] + scratch[row_at + i])
        for k in range(i32(1), radius + i32(1)):
            left, right = row_at - i32(3) * k, row_at + i32(3) * k
            weight = weights[weights_base + k]
            for i in range(line):
                scratch[done + i] = scratch[done + i] + weight * (scratch[left + i] + scratch[right + i])
        for i in range(line):
            image[start + row * line + i] = ti.cast(byte(scratch[done + i] * f32(1 / 255)), ti.u8)
