"""What JPEG leaves of an image: luminance and colour apart, colour at half of the resolution, cosine transforms of
8 x 8 pixels in whole steps, and back, as libjpeg's encoder and decoder do, but for the codes, which lose nothing.

ITU-T T.81 (1992), A.3.3 and A.3.4; JFIF 1.02 for the colours; libjpeg's triangular filter enlarges the colours again.
"""

from ..engine import ti
from .lanes import LANES, floats, high, low

COSINES = 64  # forward, and then backward

i32, f32 = ti.i32, ti.f32


@ti.func
def nearest(value: f32):
    """The nearest whole number, halves up."""
    return ti.floor(value + f32(0.5))


@ti.func
def turn(
    source: i32, source_stride: i32, to: i32, to_stride: i32, width: i32, cosines_base: i32, cosines: ti.template(),
    scratch: ti.template(),
):  # fmt: skip
    """Eight rows times a matrix of 8 x 8, from the left; each block of 8 x 8 is transposed as it is written."""
    for k in range(8):
        x = i32(0)
        while x < width:
            total = floats(0)
            for j in range(8):
                factor = cosines[cosines_base + 8 * k + j]
                for i in range(i32(LANES)):
                    total[i] = total[i] + factor * scratch[source + j * source_stride + x + i]
            for i in range(i32(LANES)):
                scratch[to + (i & 7) * to_stride + x + (i & 8) + k] = total[i]
            x += i32(LANES)


@ti.func
def quantise(
    plane: i32, height: i32, width: i32, spare: i32, steps_base: i32, steps: ti.template(), cosines: ti.template(),
    scratch: ti.template(),
):  # fmt: skip
    """A plane through its cosine transforms in whole steps and back, to whole numbers in -128..127."""
    for strip in range(height // 8):
        at = plane + strip * 8 * width
        turn(at, width, spare, width, width, i32(0), cosines, scratch)
        turn(spare, width, at, width, width, i32(0), cosines, scratch)
        for k in range(8):
            x = i32(0)
            while x < width:
                kept = floats(0)
                for i in range(i32(LANES)):
                    step = steps[steps_base + 8 * k + (i & 7)]
                    kept[i] = nearest(scratch[at + k * width + x + i] / step) * step
                for i in range(i32(LANES)):
                    scratch[at + k * width + x + i] = kept[i]
                x += i32(LANES)
        turn(at, width, spare, width, width, i32(COSINES), cosines, scratch)
        turn(spare, width, at, width, width, i32(COSINES), cosines, scratch)
        x = i32(0)
        while x < 8 * width:
            kept = floats(0)
            for i in range(i32(LANES)):
                kept[i] = low(high(nearest(scratch[at + x + i]), f32(-128.0)), f32(127.0))
            for i in range(i32(LANES)):
                scratch[at + x + i] = kept[i]
            x += i32(LANES)


@ti.func
def to_planes(
    first: i32, height: i32, width: i32, high_room: i32, wide_room: i32, luminance: i32, blue: i32, red: i32,
    image: ti.template(), scratch: ti.template(),
):  # fmt: skip
    """Luminance, and at half of the resolution what is bluer and redder, less 128; the border is continued."""
    half = wide_room >> 1
    for cell_row in range(high_room >> 1):
        for cell in range(half):
            bluer, redder = i32(0), i32(0)
            for down, across in ti.static(ti.ndrange(2, 2)):
                row, column = 2 * cell_row + down, 2 * cell + across
                at = 3 * (first + ti.min(row, height - 1) * width + ti.min(column, width - 1))
                r, g, b = ti.cast(image[at], i32), ti.cast(image[at + 1], i32), ti.cast(image[at + 2], i32)
                y = (19595 * r + 38470 * g + 7471 * b + 32768) >> 16
                scratch[luminance + row * wide_room + column] = ti.cast(y - 128, f32)
                bluer += (-11059 * r - 21709 * g + 32768 * b + 32767) >> 16
                redder += (32768 * r - 27439 * g - 5329 * b + 32767) >> 16
            odd = 1 + (cell & 1)  # libjpeg rounds up and down by turns
            scratch[blue + cell_row * half + cell] = ti.cast((bluer + odd) >> 2, f32)
            scratch[red + cell_row * half + cell] = ti.cast((redder + odd) >> 2, f32)


@ti.func
def clipped(value: i32):
    return ti.cast(low(high(value, 0), 255), ti.u8)


@ti.func
def column_sum(plane: i32, near: i32, far: i32, cell: i32, scratch: ti.template()):
    return 3 * ti.cast(scratch[plane + near + cell], i32) + ti.cast(scratch[plane + far + cell], i32)


@ti.func
def from_planes(
    first: i32, height: i32, width: i32, wide_room: i32, luminance: i32, blue: i32, red: i32, image: ti.template(),
    scratch: ti.template(),
):  # fmt: skip
    """Planes to the bytes of an image."""
    half, cells, cell_rows = wide_room >> 1, (width + 1) >> 1, (height + 1) >> 1
    for row in range(height):
        near = row >> 1
        far = ti.min(ti.max(near + 2 * (row & 1) - 1, 0), cell_rows - 1)
        near, far = near * half, far * half
        for column in range(width):
            cell, odd = column >> 1, column & 1
            beside = ti.min(ti.max(cell + 2 * odd - 1, 0), cells - 1)
            b = 3 * column_sum(blue, near, far, cell, scratch) + column_sum(blue, near, far, beside, scratch)
            r = 3 * column_sum(red, near, far, cell, scratch) + column_sum(red, near, far, beside, scratch)
            b, r = (b + 8 - odd) >> 4, (r + 8 - odd) >> 4
            y = ti.cast(scratch[luminance + row * wide_room + column], i32) + 128
            at = 3 * (first + row * width + column)
            image[at] = clipped(y + ((91881 * r + 32768) >> 16))
            image[at + 1] = clipped(y + ((-22554 * b - 46802 * r + 32768) >> 16))
            image[at + 2] = clipped(y + ((116130 * b + 32768) >> 16))


@ti.func
def compress(
    first: i32, height: i32, width: i32, base: i32, steps_base: i32, steps: ti.template(), cosines: ti.template(),
    image: ti.template(), scratch: ti.template(),
):  # fmt: skip
    """The image whose first pixel is ``first`` of all, as a JPEG decoder gives it; ``steps`` 64 for luminance and 64
    for colours. The scratch holds 1.5 planes of whole blocks and eight rows."""
    high_room, wide_room = (height + 15) & -16, (width + 31) & -32  # half a row is whole LANES
    luminance = base
    blue = luminance + high_room * wide_room
    red = blue + (high_room >> 1) * (wide_room >> 1)
    spare = red + (high_room >> 1) * (wide_room >> 1)
    to_planes(first, height, width, high_room, wide_room, luminance, blue, red, image, scratch)
    quantise(luminance, high_room, wide_room, spare, steps_base, steps, cosines, scratch)
    for colour in range(2):
        plane = ti.select(colour == 0, blue, red)
        quantise(plane, high_room >> 1, wide_room >> 1, spare, steps_base + 64, steps, cosines, scratch)
    from_planes(first, height, width, wide_room, luminance, blue, red, image, scratch)
