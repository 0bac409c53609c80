"""A row of the image: from the visibility buffer into samples, and from there to ids, classes and depth."""

from ...engine import ti
from ...kernels.lanes import LANES, SHIFT, floats, high, whole, words
from ..tables import layout
from . import shading
from .raster import MIN_INVERSE_DEPTH
from .shading import record_of, residual_ratio

i32, u32, u64, f32 = ti.i32, ti.u32, ti.u64, ti.f32


@ti.func
def read_pixels(
    column: i32, row: i32, count: i32, at: i32, seen: ti.template(), seen_blocks: ti.template(), some: ti.template()
):
    """``count`` pixels from a column on, of which nothing is seen any more; samples beyond them are like the last."""
    for i in range(i32(LANES)):
        some.u[i], some.v[i] = ti.cast(column + i, f32), ti.cast(row, f32)
    if count == LANES:
        block, drawn = seen_blocks[at >> SHIFT], u64(0)
        for i in range(i32(LANES)):
            some.record[i], some.w[i] = record_of(block[i]), residual_ratio(block[i])
        for i in range(i32(LANES)):
            drawn |= block[i]
        if drawn != 0:
            seen_blocks[at >> SHIFT] = words(0)
    else:
        for i in range(i32(LANES)):
            word = seen[at + ti.min(i, count - 1)]
            some.record[i], some.w[i] = record_of(word), residual_ratio(word)
        for i in range(count):
            seen[at + i] = u64(0)


@ti.func
def read_ground(
    column: i32, count: i32, strips: i32, w: f32, w_u: f32, bounds_base: i32, bounds: ti.template(), some: ti.template()
):
    """Strips where they are nearer than what is drawn; 1/z is ``w`` at column 0 of the row and linear."""
    for strip in range(strips):
        start, end = bounds[bounds_base + 2 * strip], bounds[bounds_base + 2 * strip + 1]
        if start < column + count and end > column:
            for i in range(i32(LANES)):
                here = ti.min(column + i, column + count - 1)
                near = high(w + w_u * ti.cast(here, f32), f32(MIN_INVERSE_DEPTH))
                covers = (here >= start) & (here < end) & (near > some.w[i])
                some.record[i] = ti.select(covers, ti.cast(strip + 1, i32), some.record[i])
                some.w[i] = ti.select(covers, near, some.w[i])


@ti.func
def compare(some: ti.template()):
    """Note whether all samples are of one record."""
    other = i32(0)
    for i in range(i32(LANES)):
        other |= some.record[i] ^ some.record[0]
    some.alone = ti.cast(other == 0, i32)


@ti.func
def clear(at: i32, count: i32, seen: ti.template()):
    """Nothing is seen any more from a place of the visibility buffer on."""
    for i in range(count):
        seen[at + i] = u64(0)


@ti.func
def name_run(first: i32, last: i32, column: i32, row: i32, node: i32, result: ti.template()):
    """Pixels ``first`` to ``last`` from a column on are a node's."""
    t = node * layout.RESULTS
    result[t + layout.BOX] = ti.min(result[t + layout.BOX], column + first)
    result[t + layout.BOX + 1] = ti.min(result[t + layout.BOX + 1], row)
    result[t + layout.BOX + 2] = ti.max(result[t + layout.BOX + 2], column + last)
    result[t + layout.BOX + 3] = row + i32(1)
    result[t + layout.PIXELS] = result[t + layout.PIXELS] + last - first


@ti.func
def label(
    column: i32, row: i32, count: i32, out: i32, first_node: i32, mark_base: i32, some: ti.template(),
    marks: ti.template(), instance: ti.template(), semantic: ti.template(), depth: ti.template(),
    instance_words: ti.template(), semantic_words: ti.template(), depth_words: ti.template(), result: ti.template(),
):  # fmt: skip
    """Ids, classes and depths of ``count`` pixels from a column on, and their nodes' extents and counts."""
    z, block = floats(0), out >> SHIFT
    for i in range(i32(LANES)):
        z[i] = f32(1.0) / some.w[i]  # infinity in the sky
    if count == LANES:
        for i in ti.static(range(LANES // 2)):
            near, far = ti.bit_cast(z[2 * i], u32), ti.bit_cast(z[2 * i + 1], u32)
            depth_words[block * (LANES // 2) + i] = ti.cast(near, u64) | (ti.cast(far, u64) << 32)
    else:
        for i in range(count):
            depth[out + i] = z[i]
    names, kinds, first, other = whole(0), whole(0), i32(0), i32(0)
    if some.alone != 0:
        m = mark_base + some.record[0] * shading.MARKS
        name, kind = marks[m + shading.LABEL], marks[m + shading.CLASS]
        for i in range(i32(LANES)):
            names[i], kinds[i] = name, kind
    else:
        for i in range(i32(LANES)):
            m = mark_base + some.record[i] * shading.MARKS
            names[i], kinds[i] = marks[m + shading.LABEL], marks[m + shading.CLASS]
        for i in range(i32(LANES)):
            other |= names[i] ^ names[0]
    if some.alone != 0 and count == LANES:
        for i in ti.static(range(LANES // 4)):
            instance_words[block * (LANES // 4) + i] = ti.cast(names[0], u64) * u64(0x0001000100010001)
        for i in ti.static(range(LANES // 8)):
            semantic_words[block * (LANES // 8) + i] = ti.cast(kinds[0], u64) * u64(0x0101010101010101)
    elif count == LANES:
        for i in ti.static(range(LANES // 4)):
            n = [ti.cast(names[4 * i + j], u64) for j in range(4)]
            instance_words[block * (LANES // 4) + i] = n[0] | (n[1] << 16) | (n[2] << 32) | (n[3] << 48)
        for i in ti.static(range(LANES // 8)):
            k = [ti.cast(kinds[8 * i + j], u64) for j in range(8)]
            start, rest = [k[j] | (k[j + 1] << 8) | (k[j + 2] << 16) | (k[j + 3] << 24) for j in (0, 4)]
            semantic_words[block * (LANES // 8) + i] = start | (rest << 32)
    else:
        for i in range(count):
            instance[out + i], semantic[out + i] = ti.cast(names[i], ti.i16), ti.cast(kinds[i], ti.u8)
    while first < count:
        end = count
        if other != 0:
            end = first + i32(1)
            while end < count and names[end] == names[first]:
                end += i32(1)
        if names[first] > 0:
            name_run(first, end, column, row, first_node + names[first] - 1, result)
        first = end


@ti.func
def even(word: u64, at: i32, width: i32, seen: ti.template()):
    """Whether a pixel and its four samples are of one record."""
    record = record_of(word)
    same = record_of(seen[at]) == record and record_of(seen[at + 1]) == record
    same = same and record_of(seen[at + 2 * width]) == record
    return same and record_of(seen[at + 2 * width + 1]) == record


@ti.func
def add_samples(
    column: i32, row: i32, filled: i32, width: i32, line: i32, fine: i32, seen: ti.template(), some: ti.template(),
    share: ti.template(),
):  # fmt: skip
    """A pixel's samples behind the ``filled`` ones: its middle, if that is all there is to see, or four.

    ``share`` is of the pixel's colour. Returns how many there are.
    """
    last, word, at = filled, seen[line + column], fine + 2 * column
    if even(word, at, width, seen):
        some.u[last], some.v[last], share[last] = ti.cast(column, f32), ti.cast(row, f32), f32(1.0)
        some.record[last], some.w[last] = record_of(word), residual_ratio(word)
        last += i32(1)
    else:
        for down, across in ti.static(ti.ndrange(2, 2)):
            word = seen[at + across + down * 2 * width]
            some.u[last], share[last] = ti.cast(column, f32) + f32(0.5 * across - 0.25), f32(0.25)
            some.v[last] = ti.cast(row, f32) + f32(0.5 * down - 0.25)
            some.record[last], some.w[last] = record_of(word), residual_ratio(word)
            last += i32(1)
    return last


@ti.func
def repeat_last(filled: i32, some: ti.template()):
    """Make the samples behind the ``filled`` ones like their last."""
    last = filled - i32(1)
    for i in range(filled, i32(LANES)):
        some.u[i], some.v[i], some.record[i], some.w[i] = some.u[last], some.v[last], some.record[last], some.w[last]


@ti.func
def add_colours(filled: i32, line_base: i32, some: ti.template(), share: ti.template(), line: ti.template()):
    """Shares of the samples' colours to those of the row's pixels."""
    for i in range(filled):
        at = line_base + 3 * ti.cast(some.u[i] + f32(0.5), i32)
        line[at] = line[at] + some.red[i] * share[i]
        line[at + 1] = line[at + 1] + some.green[i] * share[i]
        line[at + 2] = line[at + 2] + some.blue[i] * share[i]


@ti.func
def take_colours(column: i32, count: i32, line_base: i32, some: ti.template(), line: ti.template()):
    """A row's colours into the samples; zeros are left behind."""
    for i in range(count):
        at = line_base + 3 * (column + i)
        some.red[i], some.green[i], some.blue[i] = line[at], line[at + 1], line[at + 2]
        line[at], line[at + 1], line[at + 2] = f32(0.0), f32(0.0), f32(0.0)
