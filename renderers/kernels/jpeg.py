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
array = ti.types.ndarray(f32, 1)


@ti.func
def nearest(value: f32):
    """The nearest whole number, halves up."""
    return ti.floor(value + f32(0.5))


@ti.real_func
def blend(to: i32, one: i32, other: i32, count: i32, a: f32, b: f32, scratch: array):
    """A first sum of two lines."""
    for i in range(count):
        scratch[to + i] = a * scratch[one + i] + b * scratch[other + i]


@ti.real_func
def add(to: i32, one: i32, other: i32, count: i32, a: f32, b: f32, scratch: array):
    """Another sum."""
    for i in range(count):
        scratch[to + i] = scratch[to + i] + (a * scratch[one + i] + b * scratch[other + i])


@ti.func
def transform(
    to: i32, source: i32, lines: i32, count: i32, cosines_base: i32, cosines: ti.template(), scratch: ti.template()
):
    """Eight lines as sums of eight others; either lie ``lines`` apart."""
    for k in range(i32(8)):
        line, c = to + k * lines, cosines_base + i32(8) * k
        blend(line, source, source + lines, count, cosines[c], cosines[c + 1], scratch)
        for pair in range(i32(1), i32(4)):
            at, which = source + i32(2) * pair * lines, c + i32(2) * pair
            add(line, at, at + lines, count, cosines[which], cosines[which + 1], scratch)


@ti.real_func
def move(to: i32, to_lines: i32, source: i32, lines: i32, count: i32, scratch: array):
    """Eight lines to elsewhere."""
    for k in range(i32(8)):
        for i in range(count):
            scratch[to + k * to_lines + i] = scratch[source + k * lines + i]


@ti.real_func
def settle(at: i32, count: i32, step: f32, scratch: array):
    """A line in whole steps."""
    for i in range(count):
        scratch[at + i] = nearest(scratch[at + i] / step) * step


@ti.real_func
def limit(at: i32, count: i32, scratch: array):
    """A line in whole numbers of -128..127."""
    for i in range(count):
        scratch[at + i] = low(high(nearest(scratch[at + i]), f32(-128.0)), f32(127.0))


@ti.func
def quantise(
    plane: i32, rows: i32, blocks: i32, spare: i32, steps_base: i32, steps: ti.template(), cosines: ti.template(),
    scratch: ti.template(),
):  # fmt: skip
    """A plane through its cosine transforms in whole steps and back, to whole numbers in -128..127."""
    strip, other = i32(8) * blocks, spare + i32(64) * blocks
    for first in range(rows >> i32(3)):
        at = plane + first * strip
        move(spare, strip, at, rows * blocks, strip, scratch)
        transform(other, spare, strip, strip, i32(0), cosines, scratch)
        for column in range(i32(8)):
            here, there = other + column * strip, spare + column * strip
            transform(there, here, blocks, blocks, i32(0), cosines, scratch)
            for row in range(i32(8)):
                settle(there + row * blocks, blocks, steps[steps_base + 8 * row + column], scratch)
            transform(here, there, blocks, blocks, i32(COSINES), cosines, scratch)
        transform(spare, other, strip, strip, i32(COSINES), cosines, scratch)
        limit(spare, i32(8) * strip, scratch)
        move(at, rows * blocks, spare, strip, strip, scratch)


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
    quantise(luminance, rows, blocks, spare, steps_base, steps, cosines, scratch)
    for colour in range(i32(2)):
        plane = ti.select(colour == 0, blue, red)
        quantise(plane, rows >> i32(1), blocks >> i32(1), spare, steps_base + i32(64), steps, cosines, scratch)
    from_planes(first, height, width, rows, blocks, luminance, blue, red, image, scratch)
