"""Colours of what the visibility buffer holds, ``LANES`` samples at a time.

Light is added and multiplied in sRGB. A surface gets the sun's light by the cosine, where the shadow map lets it, and
the sky's: all of it if it faces upward, three quarters if upright, half if it faces down.
"""

from ...engine import ti
from ...kernels.lanes import LANES, floats, high
from ..tables.layout import AMBIENT, CLIMB, HAZE, HORIZON, LENS, LIGHT, LIGHTS, MORE, SCENE, SHADOWED, SUN
from ..tables.texture_atlas import COLUMNS, HEIGHT, WIDTH
from .shadows import sunlit
from .textures import texture_samples

# A record: the pixel at which its planes start; planes over the image, each a value and what a column and a row add, of
# both texture coordinates and of the cosines towards the sun and upward, divided by depth; 1/z's own steps; its colour;
# metres by which it counts as nearer to the sun.
FROM_U, FROM_V, PLANE_S, PLANE_T, PLANE_SUN, PLANE_UP = 0, 1, 2, 5, 8, 11
W_U, W_V, RGB, LIFT, RECORD = 14, 15, 16, 19, 20
# Its whole numbers: label or 0, class, texture, 0 for none, whether the cosines vary.
LABEL, CLASS, IMAGE, VARIES, MARKS = range(5)

i32, u32, u64, f32 = ti.i32, ti.u32, ti.u64, ti.f32


@ti.func
def lights(scene: i32, scenes: ti.template()):
    """The columns of a scene's light, in registers."""
    at = scene * SCENE + LIGHT
    return ti.Vector([ti.cast(scenes[at + i], f32) for i in range(LIGHTS)], dt=f32)


@ti.func
def record_of(word: u64):
    return ti.cast(ti.cast(word, u32), i32)


@ti.func
def residual_ratio(word: u64):
    """1/z in a word of the visibility buffer."""
    return ti.bit_cast(ti.cast(word >> 32, u32), f32)


@ti.func
def clear_air(optical: f32):
    """exp(-x) within 0.002."""
    x = optical
    taylor = f32(1.0) + x * (f32(1.0) + x * (f32(1 / 2) + x * (f32(1 / 6) + x * (f32(1 / 24) + x * f32(1 / 120)))))
    return f32(1.0) / (taylor + x * x * x * x * x * x * f32(1 / 720))


@ti.func
def run_end(first: i32, some: ti.template()):
    """The first sample after ``first`` of another record."""
    end = first + i32(1)
    while end < LANES and some.record[end] == some.record[first]:
        end += i32(1)
    return end


@ti.func
def look_up(
    all_of_them: ti.template(), first: i32, record_base: i32, mark_base: i32, records: ti.template(),
    marks: ti.template(), table: ti.template(), some: ti.template(),
):  # fmt: skip
    """Planes of a record at its samples, ``first`` and all after it, in ``all_of_them`` all; returns its texture."""
    r, m = record_base + some.record[first] * RECORD, mark_base + some.record[first] * MARKS
    texture, from_u, from_v = marks[m + IMAGE], records[r + FROM_U], records[r + FROM_V]
    sun, sun_u, sun_v = records[r + PLANE_SUN], records[r + PLANE_SUN + 1], records[r + PLANE_SUN + 2]
    up, up_u, up_v = records[r + PLANE_UP], records[r + PLANE_UP + 1], records[r + PLANE_UP + 2]
    lift, red, green, blue = records[r + LIFT], records[r + RGB], records[r + RGB + 1], records[r + RGB + 2]
    row = texture * i32(COLUMNS)
    wide, tall = ti.cast(table[row + WIDTH], f32), ti.cast(table[row + HEIGHT], f32)
    steady = ti.select(marks[m + VARIES] != 0, f32(0.0), f32(1.0))
    for i in range(i32(LANES)):
        mine, left, down = ti.static(all_of_them) or i >= first, some.u[i] - from_u, some.v[i] - from_v
        over_depth = steady * some.w[i] + (f32(1.0) - steady)
        some.sun[i] = ti.select(mine, sun * over_depth + sun_v * down + sun_u * left, some.sun[i])
        some.up[i] = ti.select(mine, up * over_depth + up_v * down + up_u * left, some.up[i])
        some.lift[i], some.red[i] = ti.select(mine, lift, some.lift[i]), ti.select(mine, red, some.red[i])
        some.green[i], some.blue[i] = ti.select(mine, green, some.green[i]), ti.select(mine, blue, some.blue[i])
        some.table[i], some.wide[i] = ti.select(mine, row, some.table[i]), ti.select(mine, wide, some.wide[i])
        some.high[i] = ti.select(mine, tall, some.high[i])
    if texture > 0:
        s, s_u, s_v = records[r + PLANE_S], records[r + PLANE_S + 1], records[r + PLANE_S + 2]
        t, t_u, t_v = records[r + PLANE_T], records[r + PLANE_T + 1], records[r + PLANE_T + 2]
        w_u, w_v = records[r + W_U], records[r + W_V]
        for i in range(i32(LANES)):
            mine, left, down = ti.static(all_of_them) or i >= first, some.u[i] - from_u, some.v[i] - from_v
            some.s[i] = ti.select(mine, s + s_v * down + s_u * left, some.s[i])
            some.t[i] = ti.select(mine, t + t_v * down + t_u * left, some.t[i])
            some.s_u[i], some.s_v[i] = ti.select(mine, s_u, some.s_u[i]), ti.select(mine, s_v, some.s_v[i])
            some.t_u[i], some.t_v[i] = ti.select(mine, t_u, some.t_u[i]), ti.select(mine, t_v, some.t_v[i])
            some.w_u[i], some.w_v[i] = ti.select(mine, w_u, some.w_u[i]), ti.select(mine, w_v, some.w_v[i])
    return texture


@ti.func
def shade(
    light, map_size: i32, map_base: i32, mark: i32, record_base: i32, mark_base: i32, records: ti.template(),
    marks: ti.template(), table: ti.template(), texels: ti.template(), shadow: ti.template(), opened: ti.template(),
    some: ti.template(),
):  # fmt: skip
    """The samples' colours."""
    textured, sky, first = i32(0), i32(0), i32(LANES)
    if some.alone == 0:
        first = run_end(0, some)
    if some.record[0] == 0:
        sky = first
    else:
        textured = look_up(True, 0, record_base, mark_base, records, marks, table, some)
    while first < LANES:
        end = run_end(first, some)
        if some.record[first] == 0:
            sky += end - first
        else:
            textured |= look_up(False, first, record_base, mark_base, records, marks, table, some)
        first = end
    length = floats(0)  # of the rays for a metre of depth
    for i in range(i32(LANES)):
        across, tall = (some.u[i] - light[LENS + 1]) * light[LENS], (some.v[i] - light[LENS + 2]) * light[LENS]
        length[i] = ti.sqrt(f32(1.0) + tall * tall + across * across)
    if sky < LANES:
        z = floats(0)
        for i in range(i32(LANES)):
            z[i] = f32(1.0) / some.w[i]
        if textured != 0:
            texture_samples(z, some, table, texels)
        through = floats(0)
        if light[SUN] > 0:
            for i in range(i32(LANES)):
                through[i] = light[SUN] * high(some.sun[i] * z[i], f32(0.0))
            if light[SHADOWED] != 0:
                sunlit(z, light, map_size, map_base, mark, shadow, opened, some, through)
        for i in range(i32(LANES)):
            all_light = light[AMBIENT] * (f32(0.75) + f32(0.25) * some.up[i] * z[i]) + through[i]
            some.red[i], some.green[i] = some.red[i] * all_light, some.green[i] * all_light
            some.blue[i] = some.blue[i] * all_light
        if light[HAZE] > 0:
            for i in range(i32(LANES)):
                clear = clear_air(z[i] * length[i] * light[HAZE])
                some.red[i] = light[HORIZON] + (some.red[i] - light[HORIZON]) * clear
                some.green[i] = light[HORIZON + 1] + (some.green[i] - light[HORIZON + 1]) * clear
                some.blue[i] = light[HORIZON + 2] + (some.blue[i] - light[HORIZON + 2]) * clear
    if sky > 0:
        for i in range(i32(LANES)):
            rise = light[CLIMB] + light[CLIMB + 1] * some.u[i] + light[CLIMB + 2] * some.v[i]
            sine, free = high(rise / length[i], f32(0.0)), some.record[i] == 0
            some.red[i] = ti.select(free, light[HORIZON] + light[MORE] * sine, some.red[i])
            some.green[i] = ti.select(free, light[HORIZON + 1] + light[MORE + 1] * sine, some.green[i])
            some.blue[i] = ti.select(free, light[HORIZON + 2] + light[MORE + 2] * sine, some.blue[i])
