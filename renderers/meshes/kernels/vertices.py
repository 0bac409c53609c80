"""Vertices of an instance, turned into an image or onto a shadow map."""

from ...engine import ti
from ..tables import layout

CORNER = 5  # floats a vertex in the scratch: u z, v z, z, u, v; on the map column, row, metres towards the sun

i32, f64 = ti.i32, ti.f64


@ti.func
def transform(k: i32, matrix: i32, divide: i32, base: i32, whole: ti.template(), real: ti.template(),
              positions: ti.template(), corners: ti.template()):  # fmt: skip
    """An instance's vertices into the scratch."""
    m, source = k * layout.REALS + matrix, ti.cast(whole[k * layout.INTEGERS + layout.VERTEX], i32) * 3
    a = ti.Vector([real[m + i] for i in range(12)], dt=f64)
    for i in range(ti.cast(whole[k * layout.INTEGERS + layout.VERTICES], i32)):
        x, y = ti.cast(positions[source + 3 * i], f64), ti.cast(positions[source + 3 * i + 1], f64)
        z, to = ti.cast(positions[source + 3 * i + 2], f64), base + i * CORNER
        u, v, depth = (a[0] * x + a[1] * y + a[2] * z + a[3], a[4] * x + a[5] * y + a[6] * z + a[7],
                       a[8] * x + a[9] * y + a[10] * z + a[11])  # fmt: skip
        corners[to], corners[to + 1], corners[to + 2] = u, v, depth
        if divide != 0 and depth >= layout.NEAR:
            corners[to + 3], corners[to + 4] = u / depth, v / depth


@ti.func
def vertex(at: i32, corners: ti.template()):
    return ti.Vector([corners[at], corners[at + 1], corners[at + 2]], dt=f64)
