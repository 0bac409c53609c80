"""What JPEG leaves of an image: luminance and colour apart, colour at half of the resolution, cosine transforms of
8 x 8 pixels in whole steps, and back, as libjpeg's encoder and decoder do, but for the codes, which lose nothing.

ITU-T T.81 (1992), A.3.3 and A.3.4; JFIF 1.02 for the colours, in libjpeg's 65536ths; its triangular filter enlarges the
colours again. A plane lies in scratch with the first columns of all blocks before all second ones, row by row, so that
both transforms go along lines.
"""

from ..engine import ti
from .lanes import high, low

COSINES = 64  # forward, and then backward

i32, f32 = ti.i32, ti.f32


@ti.func
def nearest(value: f32):
    """The nearest whole number, halves up."""
    return ti.floor(value + f32(0.5))


@ti.real_func
def quantise(
    plane: i32, rows: i32, blocks: i32, spare: i32, steps_base: i32, steps: ti.types.ndarray(f32, 1),
    cosines: ti.types.ndarray(f32, 1), scratch: ti.types.ndarray(f32, 1),
):  # fmt: skip
    """A plane through its cosine transforms in whole steps and back, to whole numbers in -128..127.

    Each strip of eight rows takes 18 transforms of eight lines, which lie a strip or a row of blocks apart: one down
    the columns, for each column of the blocks one along the rows and, in whole steps, its inverse, and one back.
    """
    strip, turned = i32(8) * blocks, spare + i32(64) * blocks
    for first in range(rows >> i32(3)):
        for k in range(i32(8)):
            at = plane + first * strip + k * rows * blocks
            for i in range(strip):
                scratch[spare + k * strip + i] = scratch[at + i]
        for step in range(i32(18)):
            inner, back = (step > 0) & (step < 17), step == 17 or (step > 0 and (step & 1) == 0)
            column = ti.select(inner, (step - i32(1)) >> i32(1), i32(0))
            lines = ti.select(inner, blocks, strip)
            from_spare = (step == 0) | (inner & back)
            source = ti.select(from_spare, spare, turned) + column * strip
            to = ti.select(from_spare, turned, spare) + column * strip
            cosine = ti.select(back, i32(COSINES), i32(0))
            for k in range(i32(8)):
                line, c = to + k * lines, cosine + i32(8) * k
                a, b = cosines[c], cosines[c + 1]
                for i in range(lines):
                    scratch[line + i] = a * scratch[source + i] + b * scratch[source + lines + i]
                for pair in range(i32(1), i32(4)):
                    one = source + i32(2) * pair * lines
                    a, b = cosines[c + 2 * pair], cosines[c + 2 * pair + 1]
                    for i in range(lines):
                        scratch[line + i] = scratch[line + i] + (a * scratch[one + i] + b * scratch[one + lines + i])
                a = ti.select(inner & (not back), steps[steps_base + i32(8) * k + column], f32(0.0))
                for i in range(ti.select(a > 0, lines, i32(0))):
                    scratch[line + i] = nearest(scratch[line + i] / a) * a
        for k in range(i32(8)):
            at = plane + first * strip + k * rows * blocks
            for i in range(strip):
                value = nearest(scratch[spare + k * strip + i])
                scratch[at + i] = low(high(value, f32(-128.0)), f32(127.0))


@ti.func
def place(row: i32, column: i32, rows: i32, blocks: i32):
    """Where a value of a plane is."""
    return ((column & 7) * rows + row) * blocks + (column >> 3)


@ti.func
def to_planes(
    first: i32, height: i32, width: i32, rows: i32, blocks: i32, luminance: i32, blue: i32, red: i32,
    image: ti.template(), scratch: ti.template(),
):  # fmt: skip
    """Luminance, and at half of the resolution what is bluer and redder, less 128; the border is continued."""
    for cell_row in range(rows >> i32(1)):
        for cell in range(blocks * i32(4)):
            bluer, redder = i32(0), i32(0)
            for down, across in ti.static(ti.ndrange(2, 2)):
                row, column = 2 * cell_row + down, 2 * cell + across
                at = 3 * (first + ti.min(row, height - 1) * width + ti.min(column, width - 1))
                r, g, b = ti.cast(image[at], i32), ti.cast(image[at + 1], i32), ti.cast(image[at + 2], i32)
                y = (19595 * r + 38470 * g + 7471 * b + 32768) >> 16
                scratch[luminance + place(row, column, rows, blocks)] = ti.cast(y - 128, f32)
                bluer += ti.cast((-11059 * r - 21709 * g + 32768 * b + 32767) >> 16, i32)
                redder += ti.cast((32768 * r - 27439 * g - 5329 * b + 32767) >> 16, i32)
            odd = 1 + (cell & 1)  # libjpeg rounds up and down by turns
            at = place(cell_row, cell, rows >> 1, blocks >> 1)
            scratch[blue + at] = ti.cast((bluer + odd) >> 2, f32)
            scratch[red + at] = ti.cast((redder + odd) >> 2, f32)


@ti.func
def three_to_one(plane: i32, near: i32, far: i32, cell: i32, rows: i32, blocks: i32, scratch: ti.template()):
    """Three of a row's value and one of the row's on the other side."""
    one, other = place(near, cell, rows, blocks), place(far, cell, rows, blocks)
    return 3 * ti.cast(scratch[plane + one], i32) + ti.cast(scratch[plane + other], i32)


@ti.func
def clipped(value: i32):
    return ti.cast(low(high(value, 0), 255), ti.u8)


@ti.func
def from_planes(
    first: i32, height: i32, width: i32, rows: i32, blocks: i32, luminance: i32, blue: i32, red: i32,
    image: ti.template(), scratch: ti.template(),
):  # fmt: skip
    """Planes to the bytes of an image."""
    cells, cell_rows = (width + i32(1)) >> i32(1), (height + i32(1)) >> i32(1)
    high_half, wide_half = rows >> i32(1), blocks >> i32(1)
    for row in range(height):
        near = row >> 1
        far = ti.min(ti.max(near + 2 * (row & 1) - 1, 0), cell_rows - 1)
        b = three_to_one(blue, near, far, i32(0), high_half, wide_half, scratch)
        r = three_to_one(red, near, far, i32(0), high_half, wide_half, scratch)
        left_b, left_r = b, r
        for cell in range(cells):
            beside = ti.min(cell + 1, cells - 1)
            right_b = three_to_one(blue, near, far, beside, high_half, wide_half, scratch)
            right_r = three_to_one(red, near, far, beside, high_half, wide_half, scratch)
            for odd in ti.static(range(2)):
                column = 2 * cell + odd
                if column < width:
                    bluer = (3 * b + ti.select(odd == 0, left_b, right_b) + 8 - odd) >> 4
                    redder = (3 * r + ti.select(odd == 0, left_r, right_r) + 8 - odd) >> 4
                    y = ti.cast(scratch[luminance + place(row, column, rows, blocks)], i32) + 128
                    at = 3 * (first + row * width + column)
                    image[at] = clipped(y + ((91881 * redder + 32768) >> 16))
                    image[at + 1] = clipped(y + ((-22554 * bluer - 46802 * redder + 32768) >> 16))
                    image[at + 2] = clipped(y + ((116130 * bluer + 32768) >> 16))
            left_b, left_r, b, r = b, r, right_b, right_r


@ti.func
def compress(
    first: i32, height: i32, width: i32, base: i32, steps_base: i32, steps: ti.template(), cosines: ti.template(),
    image: ti.template(), scratch: ti.template(),
):  # fmt: skip
    """The image whose first pixel is ``first`` of all, as a JPEG decoder gives it; ``steps`` 64 for luminance and 64
    for colours. The scratch holds 1.5 planes of whole blocks, 16 pixels wide and high, and 16 rows."""
    rows, blocks = (height + i32(15)) & i32(-16), ((width + i32(15)) & i32(-16)) >> i32(3)
    luminance = base
    blue = luminance + rows * blocks * i32(8)
    red = blue + rows * blocks * i32(2)
    spare = red + rows * blocks * i32(2)
    to_planes(first, height, width, rows, blocks, luminance, blue, red, image, scratch)
    for plane in range(i32(3)):
        halved = ti.select(plane == 0, i32(0), i32(1))
        at = ti.select(plane == 0, luminance, ti.select(plane == 1, blue, red))
        quantise(at, rows >> halved, blocks >> halved, spare, steps_base + i32(64) * halved, steps, cosines, scratch)
    from_planes(first, height, width, rows, blocks, luminance, blue, red, image, scratch)
