"""A row of the image: from the visibility buffer into samples, and from there to ids, classes and depth."""

from probscene.renderers import mesh_tables as tables
from probscene.renderers import shading_kernel as shading
from probscene.renderers.engine import ti
from probscene.renderers.lane_kernel import LANES, whole
from probscene.renderers.shading_kernel import nearness, record_of, run_end

i32, u64, f32 = ti.i32, ti.u64, ti.f32


@ti.func
def read_pixels(column: i32, row: i32, count: i32, at: i32, seen: ti.template(), some: ti.template()):
    """``count`` pixels from a column on; samples beyond them are like the last."""
    for i in range(i32(LANES)):
        some.u[i], some.v[i] = ti.cast(column + i, f32), ti.cast(row, f32)
    if count == LANES:
        for i in range(i32(LANES)):
            some.record[i], some.w[i] = record_of(seen[at + i]), nearness(seen[at + i])
    else:
        for i in range(i32(LANES)):
            word = seen[at + ti.min(i, count - 1)]
            some.record[i], some.w[i] = record_of(word), nearness(word)


@ti.func
def clear(at: i32, count: i32, seen: ti.template()):
    """Nothing is seen any more from a place of the visibility buffer on."""
    i = i32(0)
    while i + LANES <= count:
        for lane in ti.static(range(LANES)):
            seen[at + i + lane] = u64(0)
        i += i32(LANES)
    for rest in range(i, count):
        seen[at + rest] = u64(0)


@ti.func
def label(
    column: i32, row: i32, count: i32, out: i32, first_node: i32, mark_base: i32, some: ti.template(),
    marks: ti.template(), instance: ti.template(), semantic: ti.template(), depth: ti.template(), result: ti.template(),
):  # fmt: skip
    """Ids, classes and depths of ``count`` pixels from a column on, and their nodes' extents and counts."""
    ids, kinds, first = whole(0), whole(0), i32(0)
    while first < count:
        end, record = run_end(first, some), some.record[first]
        if record > 0:
            m = mark_base + record * shading.MARKS
            name, kind = marks[m + shading.LABEL], marks[m + shading.CLASS]
            for i in range(first, end):
                ids[i], kinds[i] = name, kind
            if name > 0:
                last, t = ti.min(end, count), (first_node + name - 1) * tables.RESULTS
                result[t + tables.BOX] = ti.min(result[t + tables.BOX], column + first)
                result[t + tables.BOX + 1] = ti.min(result[t + tables.BOX + 1], row)
                result[t + tables.BOX + 2] = ti.max(result[t + tables.BOX + 2], column + last)
                result[t + tables.BOX + 3] = row + i32(1)
                result[t + tables.PIXELS] = result[t + tables.PIXELS] + last - first
        first = end
    if count == LANES:
        for i in ti.static(range(LANES)):
            instance[out + i] = ti.cast(ids[i], ti.i16)
        for i in ti.static(range(LANES)):
            semantic[out + i] = ti.cast(kinds[i], ti.u8)
        for i in ti.static(range(LANES)):
            depth[out + i] = f32(1.0) / some.w[i]  # infinity in the sky
    else:
        for i in range(count):
            instance[out + i], semantic[out + i] = ti.cast(ids[i], ti.i16), ti.cast(kinds[i], ti.u8)
            depth[out + i] = f32(1.0) / some.w[i]


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
        some.record[last], some.w[last] = record_of(word), nearness(word)
        last += i32(1)
    else:
        for down, across in ti.static(ti.ndrange(2, 2)):
            word = seen[at + across + down * 2 * width]
            some.u[last], share[last] = ti.cast(column, f32) + f32(0.5 * across - 0.25), f32(0.25)
            some.v[last] = ti.cast(row, f32) + f32(0.5 * down - 0.25)
            some.record[last], some.w[last] = record_of(word), nearness(word)
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
