"""Meshes to the visibility buffer and to the shadow map: vertices, clipping, facing, planes over the image.

With vertices p = (u z, v z, z), whatever is linear over a triangle, 1 and attributes, is linear over the image once
divided by z, whether or not the triangle reaches behind the camera: the attribute's plane is the sum of its values
times the cross products of the other two vertices, over the triple product (Olano and Greer 1997). So planes need no
clipping, only outlines do.
"""

from ...engine import ti
from ...kernels.lanes import high, low
from ..tables import atlas, layout
from . import shading
from .raster import fill, up
from .vertices import CORNER, transform, vertex

STEEPEST = 1.0  # metres; see record_triangle

i32, u64, f32, f64 = ti.i32, ti.u64, ti.f32, ti.f64


@ti.func
def at_near(inside, outside):
    """Where an edge meets the near plane; from the inside, so that both triangles find the same."""
    share = (layout.NEAR - inside[2]) / (outside[2] - inside[2])
    u, v = inside[0] + (outside[0] - inside[0]) * share, inside[1] + (outside[1] - inside[1]) * share
    return u / layout.NEAR, v / layout.NEAR


@ti.func
def cosines(n: i32, m: i32, real: ti.template(), faces: ti.template()):
    """A normal's cosines towards the sun and upward, in an instance that is turned and scaled."""
    x, y, z = faces[n], faces[n + 1], faces[n + 2]
    a, b = x * ti.cast(real[m + layout.UNSCALE], f32), y * ti.cast(real[m + layout.UNSCALE + 1], f32)
    c = z * ti.cast(real[m + layout.UNSCALE + 2], f32)
    share = f32(1.0) / high(ti.sqrt(a * a + b * b + c * c), f32(1e-12))
    sun = x * ti.cast(real[m + layout.TO_SUN], f32) + y * ti.cast(real[m + layout.TO_SUN + 1], f32)
    sun += z * ti.cast(real[m + layout.TO_SUN + 2], f32)
    return sun * share, c * share


@ti.func
def put_plane(at: i32, plane, u: f64, v: f64, records: ti.template()):
    """A plane with columns' and rows' steps and a constant, as its value at (u, v) and the steps."""
    records[at] = ti.cast(plane[0] * u + plane[1] * v + plane[2], f32)
    records[at + 1], records[at + 2] = ti.cast(plane[0], f32), ti.cast(plane[1], f32)


@ti.func
def put_number(at: i32, number: f32, records: ti.template()):
    """What is the same all over a triangle."""
    records[at], records[at + 1], records[at + 2] = number, f32(0.0), f32(0.0)


@ti.func
def record_triangle(
    k: i32, face: i32, r: i32, m: i32, from_u: f64, from_v: f64, texel: f64, p, q, o,
    whole: ti.template(), real: ti.template(), faces: ti.template(), records: ti.template(), marks: ti.template(),
):  # fmt: skip
    """What shading needs of a triangle; ``p, q, o`` are the planes of its corners' shares, over depth.

    Light finds it nearer to the sun by as much as it rises over a texel of the shadow map, lest it shade itself.
    """
    s, w, texture = k * layout.REALS, p + q + o, ti.cast(whole[k * layout.INTEGERS + layout.TEXTURE], i32)
    records[r + shading.FROM_U], records[r + shading.FROM_V] = ti.cast(from_u, f32), ti.cast(from_v, f32)
    records[r + shading.W_U], records[r + shading.W_V] = ti.cast(w[0], f32), ti.cast(w[1], f32)
    sun0, up0 = cosines(face + atlas.NORMAL, s, real, faces)
    varies, least = faces[face + atlas.SMOOTH] != 0, sun0
    if varies:
        sun1, up1 = cosines(face + atlas.NORMAL + 3, s, real, faces)
        sun2, up2 = cosines(face + atlas.NORMAL + 6, s, real, faces)
        least = low(sun0, low(sun1, sun2))
        sun = p * ti.cast(sun0, f64) + q * ti.cast(sun1, f64) + o * ti.cast(sun2, f64)
        put_plane(r + shading.PLANE_SUN, sun, from_u, from_v, records)
        rise = p * ti.cast(up0, f64) + q * ti.cast(up1, f64) + o * ti.cast(up2, f64)
        put_plane(r + shading.PLANE_UP, rise, from_u, from_v, records)
    else:
        put_number(r + shading.PLANE_SUN, sun0, records)
        put_number(r + shading.PLANE_UP, up0, records)
    least = high(least, f32(0.01))
    lift = ti.cast(texel, f32) * ti.sqrt(high(f32(1.0) - least * least, f32(0.0))) / least
    records[r + shading.LIFT] = low(lift, f32(STEEPEST))
    if texture > 0:
        for axis in ti.static(range(2)):
            f = face + atlas.UV + axis
            plane = p * ti.cast(faces[f], f64) + q * ti.cast(faces[f + 2], f64) + o * ti.cast(faces[f + 4], f64)
            put_plane(r + shading.PLANE_S + 3 * axis, plane, from_u, from_v, records)
    for channel in ti.static(range(3)):
        colour = faces[face + atlas.COLOUR + channel]
        if faces[face + atlas.TINTED] != 0:
            colour *= ti.cast(real[s + layout.TINT + channel], f32)
        records[r + shading.RGB + channel] = colour
    marks[m + shading.LABEL] = ti.cast(whole[k * layout.INTEGERS + layout.NODE] + 1, i32)
    marks[m + shading.CLASS] = ti.cast(whole[k * layout.INTEGERS + layout.SEMANTIC], i32)
    marks[m + shading.IMAGE], marks[m + shading.VARIES] = texture, ti.cast(varies, i32)


@ti.func
def draw_instance(
    k: i32, count: i32, node: i32, height: i32, width: i32, zooms: i32, base: i32, fine_base: i32,
    stamp_base: i32, corner_base: i32, record_base: i32, mark_base: i32, texel: f64,
    whole: ti.template(), real: ti.template(), positions: ti.template(), triangles: ti.template(),
    faces: ti.template(), seen: ti.template(), shadow: ti.template(), stamp: ti.template(), corners: ti.template(),
    records: ti.template(), marks: ti.template(), extent: ti.template(),
):  # fmt: skip
    """Draw what faces the camera with records from ``count + 1`` on.

    ``zooms`` is 2 where there is a second buffer, at ``fine_base``, of twice as many columns and rows. Returns the last
    record, and how many pixels of the node were stamped.
    """
    transform(k, layout.TO_IMAGE, 1, corner_base, whole, real, positions, corners)
    first, last, area = ti.cast(whole[k * layout.INTEGERS + layout.TRIANGLE], i32), count, i32(0)
    in_sight = whole[k * layout.INTEGERS + layout.SEEN] != 0
    low_u, low_v, high_u, high_v = f64(1e300), f64(1e300), f64(-1e300), f64(-1e300)
    for t in range(first, first + ti.cast(whole[k * layout.INTEGERS + layout.TRIANGLES], i32)):
        at0, at1 = corner_base + triangles[3 * t] * CORNER, corner_base + triangles[3 * t + 1] * CORNER
        at2 = corner_base + triangles[3 * t + 2] * CORNER
        z0, z1, z2 = corners[at0 + 2], corners[at1 + 2], corners[at2 + 2]
        behind = ti.cast(z0 < layout.NEAR, i32) + ti.cast(z1 < layout.NEAR, i32) + ti.cast(z2 < layout.NEAR, i32)
        u0, v0, u1, v1, u2, v2, u3, v3 = f64(0.0), f64(0.0), f64(0.0), f64(0.0), f64(0.0), f64(0.0), f64(0.0), f64(0.0)
        front = False
        if behind == 0:
            u0, v0, u1, v1 = corners[at0 + 3], corners[at0 + 4], corners[at1 + 3], corners[at1 + 4]
            u2, v2 = corners[at2 + 3], corners[at2 + 4]
            front = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0) < 0
        elif behind < 3:
            a, b, c = vertex(at0, corners), vertex(at1, corners), vertex(at2, corners)
            front = a.dot(b.cross(c)) < 0
            if front:
                odd_1 = (z1 < layout.NEAR) == (behind == 1)  # which corner is alone on its side of the plane
                odd_2 = (z2 < layout.NEAR) == (behind == 1)
                if odd_1:
                    a, b, c = b, c, a
                elif odd_2:
                    a, b, c = c, a, b
                if behind == 1:
                    u0, v0 = at_near(b, a)
                    u1, v1, u2, v2 = b[0] / b[2], b[1] / b[2], c[0] / c[2], c[1] / c[2]
                    u3, v3 = at_near(c, a)
                else:
                    u0, v0 = a[0] / a[2], a[1] / a[2]
                    u1, v1 = at_near(a, b)
                    u2, v2 = at_near(a, c)
        if front:
            least_u, largest_u = low(u0, low(u1, u2)), high(u0, high(u1, u2))
            least_v, largest_v = low(v0, low(v1, v2)), high(v0, high(v1, v2))
            if behind == 1:
                least_u, largest_u = low(least_u, u3), high(largest_u, u3)
                least_v, largest_v = low(least_v, v3), high(largest_v, v3)
            low_u, high_u = low(low_u, least_u), high(high_u, largest_u)
            low_v, high_v = low(low_v, least_v), high(high_v, largest_v)
            column, row = up(least_u, width), up(least_v, height)
            covers = column < up(largest_u, width) and row < up(largest_v, height)
            if zooms == 2 and not covers:
                across = up(2 * least_u + 0.5, 2 * width) < up(2 * largest_u + 0.5, 2 * width)
                covers = across and up(2 * least_v + 0.5, 2 * height) < up(2 * largest_v + 0.5, 2 * height)
            if in_sight and covers:
                a, b, c = vertex(at0, corners), vertex(at1, corners), vertex(at2, corners)
                p, q, o = b.cross(c), c.cross(a), a.cross(b)
                scale = f64(1.0) / a.dot(p)
                p, q, o = p * scale, q * scale, o * scale
                w = p + q + o
                visible = i32(0)
                for piece in range(ti.select(behind == 1, i32(2), i32(1))):
                    if piece == 1:
                        u1, v1, u2, v2 = u2, v2, u3, v3
                    for zoom in range(i32(1), zooms + i32(1)):
                        by, shift = ti.cast(zoom, f64), 0.5 * ti.cast(zoom - 1, f64)
                        seen_here, fresh = fill(
                            u0 * by + shift, v0 * by + shift, u1 * by + shift, v1 * by + shift, u2 * by + shift,
                            v2 * by + shift, w[2] - (w[0] + w[1]) * shift / by, w[0] / by, w[1] / by, last + 1,
                            ti.cast(node >= 0 and zoom == 1, i32), height * zoom, width * zoom,
                            ti.select(zoom == 1, base, fine_base), stamp_base, seen, shadow, stamp,
                        )  # fmt: skip
                        visible, area = visible | seen_here, area + fresh
                if visible != 0:
                    last += i32(1)
                    record_triangle(
                        k, t * atlas.FACE, record_base + last * shading.RECORD, mark_base + last * shading.MARKS,
                        ti.cast(ti.min(column, width - 1), f64), ti.cast(ti.min(row, height - 1), f64), texel, p, q, o,
                        whole, real, faces, records, marks,
                    )  # fmt: skip
    if node >= 0 and low_u <= high_u:
        e = node * layout.EXTENT
        extent[e], extent[e + 1] = low(extent[e], low_u + 0.5), low(extent[e + 1], low_v + 0.5)
        extent[e + 2], extent[e + 3] = high(extent[e + 2], high_u + 0.5), high(extent[e + 3], high_v + 0.5)
    return last, area


@ti.func
def unstamp(node: i32, height: i32, width: i32, stamp_base: i32, extent: ti.template(), stamp: ti.template()):
    """Clear the stamps of a node, which lie within its extent."""
    e, across = node * layout.EXTENT, (width + 63) >> 6
    left, right = up(extent[e] - 1, width) >> 6, (up(extent[e + 2], width) + i32(63)) >> 6
    for row in range(up(extent[e + 1] - 1, height), up(extent[e + 3], height)):
        for word in range(left, right):
            stamp[stamp_base + row * across + word] = u64(0)


@ti.func
def ray(at: i32, scenes: ti.template()):
    """An axis of the world along a pixel's ray, as a plane."""
    return ti.Vector([scenes[at + 1], scenes[at + 2], scenes[at]], dt=f64)


@ti.func
def lay_ground(
    scene: i32, strips: i32, record_base: i32, mark_base: i32, middle_u: f64, middle_v: f64, scenes: ti.template(),
    strip: ti.template(), tiles: ti.template(), records: ti.template(), marks: ti.template(),
):  # fmt: skip
    """The records of the strips, 1 to ``strips``: planes like any triangle's; record 0, the sky, has no label."""
    s = scene * layout.SCENE
    x, y = ray(s + layout.RAY, scenes), ray(s + layout.RAY + 3, scenes)
    w = ray(s + layout.RAY + 6, scenes) / -scenes[s + layout.EYE + 2]
    across = w * scenes[s + layout.EYE + 1] + y
    along = w * (scenes[s + layout.EYE] - scenes[s + layout.OFFSET]) + x
    for i in ti.static(range(shading.MARKS)):
        marks[mark_base + i] = i32(0)
    for i in range(strips):
        r, m = record_base + (i + 1) * shading.RECORD, mark_base + (i + 1) * shading.MARKS
        at = 2 * (scene * strips + i)
        records[r + shading.FROM_U], records[r + shading.FROM_V] = ti.cast(middle_u, f32), ti.cast(middle_v, f32)
        records[r + shading.W_U], records[r + shading.W_V] = ti.cast(w[0], f32), ti.cast(w[1], f32)
        put_plane(r + shading.PLANE_S, across / -tiles[at + 1], middle_u, middle_v, records)
        put_plane(r + shading.PLANE_T, along / tiles[at], middle_u, middle_v, records)
        put_number(r + shading.PLANE_SUN, ti.cast(scenes[s + layout.SUN_UP], f32), records)
        put_number(r + shading.PLANE_UP, 1.0, records)
        records[r + shading.LIFT] = f32(0.0)
        for channel in ti.static(range(3)):
            records[r + shading.RGB + channel] = f32(1.0)
        marks[m + shading.LABEL], marks[m + shading.CLASS] = i32(0), strip[at + 1]
        marks[m + shading.IMAGE], marks[m + shading.VARIES] = strip[at], i32(0)
