"""The shadow map: how far towards the sun the first thing is, for each texel, seen along the light.

The map is cleared, written and read in tiles of 16 x 16, and only those that something may cast a shadow on.
"""

from ...engine import ti
from ...kernels.lanes import LANES, floats, high, low, whole
from ..tables import layout
from ..tables.layout import ON_MAP
from .raster import by_height, columns, draw_span, up
from .vertices import CORNER, transform, vertex

NOTHING = -1e30
TILE = 4  # bits of a tile's width
SPARE = 1 << 2 * TILE  # texels behind each worker's map, a tile of them, which ``draw_span`` may write to
SLACK = 0.02  # metres by which a shadow keeps off what casts it

i32, f32, f64 = ti.i32, ti.f32, ti.f64


@ti.func
def tile_at(column: i32, row: i32, base: i32, size: i32):
    """The tile of the shadow map that a texel lies in; ``base`` is the map's."""
    return (base >> 2 * TILE) + (row >> TILE) * (size >> TILE) + (column >> TILE)


@ti.func
def open_tiles(k: i32, mark: i32, size: i32, base: i32, whole: ti.template(), shadow: ti.template(),
               shadow_words: ti.template(), opened: ti.template()):  # fmt: skip
    """Clear the tiles of the shadow map that an instance may reach, and one texel beyond; to be done for all at first.

    Where no tile is opened nothing casts a shadow, and the map is never read.
    """
    at = k * layout.INTEGERS + layout.MAP_BOX
    nothing = ti.cast(ti.bit_cast(f32(NOTHING), ti.u32), ti.u64)
    two = (nothing << 32) | nothing
    left, top = ti.cast(whole[at], i32) >> TILE, ti.cast(whole[at + 1], i32) >> TILE
    right, bottom = ti.cast(whole[at + 2], i32) >> TILE, ti.cast(whole[at + 3], i32) >> TILE
    for row in range(top, bottom + i32(1)):
        for column in range(left, right + i32(1)):
            tile = tile_at(column << TILE, row << TILE, base, size)
            if opened[tile] != mark:
                opened[tile] = mark
                from_x, from_y = column << TILE, row << TILE
                for y in range(from_y, ti.min(from_y + i32(17), size)):
                    line = base + y * size + from_x
                    for i in ti.static(range(8)):
                        shadow_words[(line >> TILE) * 8 + i] = two
                    if from_x + i32(16) < size:
                        shadow[line + 16] = f32(NOTHING)


@ti.func
def fill_map(
    a0: f64, b0: f64, a1: f64, b1: f64, a2: f64, b2: f64, d: f64, d_u: f64, d_v: f64,
    size: i32, base: i32, seen: ti.template(), shadow: ti.template(),
):  # fmt: skip
    """Keep what is nearest to the sun; its distance is ``d`` at the first texel and linear."""
    u0, v0, u1, v1, u2, v2 = by_height(a0, b0, a1, b1, a2, b2)
    whole, upper, lower = (u2 - u0) / (v2 - v0), (u1 - u0) / (v1 - v0), (u2 - u1) / (v2 - v1)
    slope = ti.cast(d_u, f32)
    for row in range(up(v0, size), up(v2, size)):
        y = ti.cast(row, f64)
        first, last = columns(y, u0, v0, v1, u1, whole, upper, lower, size)
        start = ti.cast(d + d_v * y + d_u * ti.cast(first, f64), f32)
        draw_span(base + row * size + first, last - first, start, slope, i32(-1), seen, shadow)


@ti.func
def cast_shadow(
    k: i32, size: i32, base: i32, corner_base: i32, whole: ti.template(), real: ti.template(),
    positions: ti.template(), triangles: ti.template(), seen: ti.template(), shadow: ti.template(),
    corners: ti.template(),
):  # fmt: skip
    """Draw an instance on the shadow map; of a closed mesh the triangles that face the sun will do."""
    transform(k, layout.TO_MAP, 0, corner_base, whole, real, positions, corners)
    first = ti.cast(whole[k * layout.INTEGERS + layout.TRIANGLE], i32)
    closed = whole[k * layout.INTEGERS + layout.CLOSED] != 0
    for t in range(first, first + ti.cast(whole[k * layout.INTEGERS + layout.TRIANGLES], i32)):
        a = vertex(corner_base + triangles[3 * t] * CORNER, corners)
        b = vertex(corner_base + triangles[3 * t + 1] * CORNER, corners)
        c = vertex(corner_base + triangles[3 * t + 2] * CORNER, corners)
        one, other = b - a, c - a
        faces = one[0] * other[1] - one[1] * other[0]  # the sun, where positive
        if faces > 0 or (faces < 0 and not closed):
            across = up(low(a[0], low(b[0], c[0])), size) < up(high(a[0], high(b[0], c[0])), size)
            if across and up(low(a[1], low(b[1], c[1])), size) < up(high(a[1], high(b[1], c[1])), size):
                d_u = (one[2] * other[1] - one[1] * other[2]) / faces
                d_v = (one[0] * other[2] - one[2] * other[0]) / faces
                start = a[2] - d_u * a[0] - d_v * a[1]
                fill_map(a[0], a[1], b[0], b[1], c[0], c[1], start - SLACK, d_u, d_v, size, base, seen, shadow)


@ti.func
def let(shadow: f32, near: f32):
    """Whether light gets to what is so near to the sun."""
    return ti.select(near >= shadow, f32(1.0), f32(0.0))


@ti.func
def sunlit(
    z: ti.template(), light, size: i32, base: i32, mark: i32, shadow: ti.template(), opened: ti.template(),
    some: ti.template(), through: ti.template(),
):  # fmt: skip
    """Multiply light by the share of the four nearest texels of the shadow map that let it through, by their distance.

    ``z`` are depths of the samples; beyond the map everything is lit.
    """
    columns, rows, near = floats(0), floats(0), floats(0)
    for i in range(i32(LANES)):
        u, v = some.u[i], some.v[i]
        columns[i] = light[ON_MAP] + z[i] * (light[ON_MAP + 1] + light[ON_MAP + 2] * u + light[ON_MAP + 3] * v)
        rows[i] = light[ON_MAP + 4] + z[i] * (light[ON_MAP + 5] + light[ON_MAP + 6] * u + light[ON_MAP + 7] * v)
        ray = light[ON_MAP + 9] + light[ON_MAP + 10] * u + light[ON_MAP + 11] * v
        near[i] = some.lift[i] + light[ON_MAP + 8] + z[i] * ray
    tile, place, across, down = whole(0), whole(0), floats(0), floats(0)
    most = ti.cast(size - 1, f32)
    for i in range(i32(LANES)):
        column, row = low(high(columns[i], f32(0.0)), most), low(high(rows[i], f32(0.0)), most)
        x, y = ti.cast(column, i32), ti.cast(row, i32)
        across[i], down[i] = column - ti.cast(x, f32), row - ti.cast(y, f32)
        tile[i] = (y >> TILE) * (size >> TILE) + (x >> TILE)
        on = (columns[i] >= 0) & (rows[i] >= 0) & (columns[i] < most) & (rows[i] < most) & (through[i] > 0)
        place[i] = ti.select(on, y * size + x, i32(-1))
    first_tile, signs = base >> 2 * TILE, i32(-1)
    for i in range(i32(LANES)):
        place[i] = ti.select(opened[first_tile + tile[i]] == mark, place[i], i32(-1))
    for i in range(i32(LANES)):
        signs &= place[i]
    if signs >= 0:  # somewhere a shadow may fall; then all are looked up, which takes less than to choose
        a, b, c, d = floats(0), floats(0), floats(0), floats(0)
        for i in range(i32(LANES)):
            at = base + ti.max(place[i], i32(0))
            under = at + size
            a[i], b[i], c[i], d[i] = shadow[at], shadow[at + 1], shadow[under], shadow[under + 1]
        for i in range(i32(LANES)):
            upper, lower = let(a[i], near[i]), let(c[i], near[i])
            upper += (let(b[i], near[i]) - upper) * across[i]
            lower += (let(d[i], near[i]) - lower) * across[i]
            share = ti.select(place[i] >= 0, upper + (lower - upper) * down[i], f32(1.0))
            through[i] = through[i] * share
