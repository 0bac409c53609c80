"""Rows and columns of a triangle or a strip of ground, and what is written there.

A sample belongs to a triangle if it lies between its edges, on the left or the upper one included, so that triangles
that share an edge share no sample and leave none out: the edge is the same arithmetic on the same two numbers for both.
The visibility buffer keeps the greatest of 64-bit words, the bits of 1/z above the record; of equals the later record.
"""

from ...engine import ti
from ...kernels.lanes import high, low, whole_lanes
from ..tables import layout

MIN_INVERSE_DEPTH = 1e-9  # of 1/z, which rounding may not take to 0 or below

i32, u32, u64, f32, f64 = ti.i32, ti.u32, ti.u64, ti.f32, ti.f64


@ti.func
def up(value: f64, most: i32):
    """The first whole number not below the value, within 0..most."""
    bounded = low(high(value, f64(0.0)), ti.cast(most, f64))
    whole = ti.cast(bounded, i32)  # the real ceil is a call
    return whole + ti.cast(ti.cast(whole, f64) < bounded, i32)


@ti.func
def key(w: f32, record: i32):
    """A word of the visibility buffer."""
    return (ti.cast(ti.bit_cast(high(w, f32(MIN_INVERSE_DEPTH)), u32), u64) << 32) | ti.cast(record, u64)


@ti.func
def by_height(u0: f64, v0: f64, u1: f64, v1: f64, u2: f64, v2: f64):
    """The same corners from the top to the bottom."""
    if v1 < v0:
        u0, v0, u1, v1 = u1, v1, u0, v0
    if v2 < v1:
        u1, v1, u2, v2 = u2, v2, u1, v1
    if v1 < v0:
        u0, v0, u1, v1 = u1, v1, u0, v0
    return u0, v0, u1, v1, u2, v2


@ti.func
def columns(y: f64, u0: f64, v0: f64, v1: f64, u1: f64, whole: f64, upper: f64, lower: f64, width: i32):
    """First and last column, exclusive, of a triangle's row; slopes of the whole side, of the upper and the lower."""
    one, other = u0 + (y - v0) * whole, u0 + (y - v0) * upper
    if y >= v1:
        other = u1 + (y - v1) * lower
    return up(low(one, other), width), up(high(one, other), width)


@ti.func
def stamp_row(first: i32, last: i32, at: i32, stamp: ti.template()):
    """Set the bits of columns ``first`` to ``last`` of a row of stamps; returns how many were not set."""
    fresh = i32(0)
    for word in range(first >> 6, (last + i32(63)) >> 6):
        begin, end = ti.max(first - (word << 6), i32(0)), ti.min(last - (word << 6), i32(64))
        bits = (~u64(0) >> ti.cast(64 - end + begin, u64)) << ti.cast(begin, u64)
        old = stamp[at + word]
        fresh += ti.cast(ti.math.popcnt(bits & ~old), i32)
        stamp[at + word] = old | bits
    return fresh


@ti.real_func
def draw_span(
    at: i32, count: i32, start: f32, slope: f32, record: i32, seen: ti.types.ndarray(u64, 1),
    shadow: ti.types.ndarray(f32, 1),
) -> i32:  # fmt: skip
    """Draw samples from a place of the visibility buffer on, or where the record is -1 texels of the shadow map.

    1/z of a sample, how near to the sun a texel is, is ``start`` at the first and linear. Up to ``LANES - 1`` behind
    them are written as they were. Returns whether any sample is seen.
    """
    changed = u64(0)
    if record >= 0:
        for i in range(whole_lanes(count)):
            old, word = seen[at + i], key(start + slope * ti.cast(i, f32), record)
            new = ti.select((i < count) & (word > old), word, old)
            changed |= new ^ old
            seen[at + i] = new
    else:
        for i in range(whole_lanes(count)):
            old, near = shadow[at + i], start + slope * ti.cast(i, f32)
            shadow[at + i] = ti.select((i < count) & (near > old), near, old)
    return ti.cast(changed != 0, i32)


@ti.func
def fill(
    a0: f64, b0: f64, a1: f64, b1: f64, a2: f64, b2: f64, w: f64, w_u: f64, w_v: f64, record: i32, stamped: i32,
    height: i32, width: i32, base: i32, stamp_base: i32, seen: ti.template(), shadow: ti.template(),
    stamp: ti.template(),
):  # fmt: skip
    """Draw a triangle with corners (a, b) of columns and rows; 1/z is ``w`` at the first sample and linear.

    Where it is to be ``stamped`` the samples that were not yet are counted. Returns whether any of it is seen, and the
    count.
    """
    u0, v0, u1, v1, u2, v2 = by_height(a0, b0, a1, b1, a2, b2)
    whole, upper, lower = (u2 - u0) / (v2 - v0), (u1 - u0) / (v1 - v0), (u2 - u1) / (v2 - v1)
    slope, visible, area = ti.cast(w_u, f32), i32(0), i32(0)
    for row in range(up(v0, height), up(v2, height)):
        y = ti.cast(row, f64)
        first, last = columns(y, u0, v0, v1, u1, whole, upper, lower, width)
        if first < last:
            start = ti.cast(w + w_v * y + w_u * ti.cast(first, f64), f32)
            visible |= draw_span(base + row * width + first, last - first, start, slope, record, seen, shadow)
            if stamped != 0:
                area += stamp_row(first, last, stamp_base + row * ((width + 63) >> 6), stamp)
    return visible, area


@ti.func
def beyond(start: i32, end: i32, constant: f64, slope: f64):
    """The columns of ``start..end`` at which ``constant + slope * column`` is positive: a part at one of its ends."""
    first, last = start, end
    if slope == 0:
        if constant <= 0:
            last = first
    else:
        at = ti.max(up(-constant / slope, end), start)
        if slope > 0:
            first = at
        else:
            last = at
    return first, last


@ti.func
def strip_row(
    scene: i32, strips: i32, row: i32, width: i32, zoom: f64, origin: f64, bounds_base: i32,
    scenes: ti.template(), edges: ti.template(), bounds: ti.template(),
):  # fmt: skip
    """First and last column, exclusive, of each strip in a row; samples are at ``origin + zoom * column``.

    A column is in the strip above an edge where the ray's y is; that and 1/z, which is returned, are linear along a
    row.
    """
    s = scene * layout.SCENE
    eye_y, eye_z = scenes[s + layout.EYE + 1], scenes[s + layout.EYE + 2]
    y_u, z_u = scenes[s + layout.RAY + 4] * zoom, scenes[s + layout.RAY + 7] * zoom
    v = origin + zoom * ti.cast(row, f64)
    ray_y = scenes[s + layout.RAY + 3] + scenes[s + layout.RAY + 4] * origin + scenes[s + layout.RAY + 5] * v
    ray_z = scenes[s + layout.RAY + 6] + scenes[s + layout.RAY + 7] * origin + scenes[s + layout.RAY + 8] * v
    left, right = beyond(0, width, -ray_z, -z_u)
    left, right = beyond(left, right, eye_z / layout.NEAR + ray_z, z_u)
    for strip in range(strips):
        a, b = left, right  # what lies above the edges so far
        if strip < strips - 1:
            gap = eye_y - edges[scene * (strips - 1) + strip]
            constant, slope = gap * ray_z - eye_z * ray_y, gap * z_u - eye_z * y_u
            a, b = beyond(left, right, constant, slope)
            if a > left:
                right = a
            else:
                left = b
        bounds[bounds_base + 2 * strip], bounds[bounds_base + 2 * strip + 1] = a, b
    return ti.cast(-ray_z / eye_z, f32), ti.cast(-z_u / eye_z, f32)


@ti.func
def lay_row(
    scene: i32, strips: i32, row: i32, width: i32, line: i32, zoom: f64, origin: f64, bounds_base: i32,
    scenes: ti.template(), edges: ti.template(), bounds: ti.template(), seen: ti.template(),
):  # fmt: skip
    """Draw a row of the strips with records 1 to ``strips``."""
    w, w_u = strip_row(scene, strips, row, width, zoom, origin, bounds_base, scenes, edges, bounds)
    for strip in range(strips):
        for column in range(bounds[bounds_base + 2 * strip], bounds[bounds_base + 2 * strip + 1]):
            seen[line + column] = high(key(w + w_u * ti.cast(column, f32), strip + 1), seen[line + column])
