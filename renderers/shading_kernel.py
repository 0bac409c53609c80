"""Colours of what the visibility buffer holds, a run of pixels of one record at a time, and their bytes.

Light is added and multiplied in sRGB. A surface gets the sun's light by the cosine, where the shadow map lets it, and
the sky's: all of it if it faces upward, three quarters if upright, half if it faces down.
"""

from probscene.renderers.engine import ti
from probscene.renderers.mesh_tables import (
    AMBIENT,
    BLOCK,
    CLIMB,
    HAZE,
    HORIZON,
    LENS,
    LIGHT,
    LIGHTS,
    MORE,
    ON_MAP,
    SCENE,
    SHADOWED,
    SUN,
)
from probscene.renderers.photo_kernel import put
from probscene.renderers.raster_kernel import high
from probscene.renderers.shadow_kernel import sunlit
from probscene.renderers.texture_atlas import AT, COLUMNS, HEIGHT, LEVELS, LEVELS_X, LEVELS_Y, WIDTH
from probscene.renderers.texture_kernel import level, place, sample

# A record: the pixel at which its planes start; planes over the image, each a value and what a column and a row add, of
# both texture coordinates and of the cosines towards the sun and upward, divided by depth; 1/z's own steps; its colour;
# metres by which it counts as nearer to the sun.
FROM_U, FROM_V, PLANE_S, PLANE_T, PLANE_SUN, PLANE_UP = 0, 1, 2, 5, 8, 11
W_U, W_V, RGB, LIFT, RECORD = 14, 15, 16, 19, 20
# Its whole numbers: label or 0, class, texture or -1, whether the cosines vary.
LABEL, CLASS, IMAGE, VARIES, MARKS = range(5)

i32, i64, u32, u64, f32 = ti.i32, ti.i64, ti.u32, ti.u64, ti.f32
INFINITY = float("inf")


@ti.func
def lights(scene: i32, scenes: ti.template()):
    """The columns of a scene's light, in registers."""
    at = scene * SCENE + LIGHT
    return ti.Vector([ti.cast(scenes[at + i], f32) for i in range(LIGHTS)], dt=f32)


@ti.func
def depth_of(word: u64):
    """1/z in a word of the visibility buffer."""
    return ti.bit_cast(ti.cast(word >> 32, u32), f32)


@ti.func
def clear_air(optical: f32):
    """exp(-x) within 0.002."""
    x = optical
    taylor = f32(1.0) + x * (f32(1.0) + x * (f32(1 / 2) + x * (f32(1 / 6) + x * (f32(1 / 24) + x * f32(1 / 120)))))
    return f32(1.0) / (taylor + x * x * x * x * x * x * f32(1 / 720))


@ti.func
def shade(
    record: i32, at: i32, first: i32, count: i32, u: f32, v: f32, share: f32, pixel: i32, out: i32, light, seed: i64,
    map_size: i32, map_base: i32, mark: i32, record_base: i32, mark_base: i32, line_base: i32, tap: ti.template(),
    seen: ti.template(), shadow: ti.template(), opened: ti.template(), records: ti.template(), marks: ti.template(),
    table: ti.template(), texels: ti.template(), line: ti.template(), image: ti.template(), depth: ti.template(),
):  # fmt: skip
    """Colours and depths of one record's pixels from column ``first``; the first one's sample is (u, v).

    Of a ``tap``, one of four samples or all of them at once, a share of the colours is added, and depth left alone.
    What hardly changes is computed once for a block of a few pixels: levels of a texture, lengths of rays.
    """
    r, m = record_base + record * RECORD, mark_base + record * MARKS
    texture, varies = marks[m + IMAGE], marks[m + VARIES] != 0
    left, down = u - records[r + FROM_U], v - records[r + FROM_V]
    s_u, t_u, sun_u, up_u = records[r + PLANE_S + 1], records[r + PLANE_T + 1], records[r + PLANE_SUN + 1], f32(0.0)
    s_v, t_v = records[r + PLANE_S + 2], records[r + PLANE_T + 2]
    s_row, t_row = records[r + PLANE_S] + s_v * down, records[r + PLANE_T] + t_v * down
    sun_row, up_row = records[r + PLANE_SUN], records[r + PLANE_UP]
    if varies:
        up_u = records[r + PLANE_UP + 1]
        sun_row += records[r + PLANE_SUN + 2] * down
        up_row += records[r + PLANE_UP + 2] * down
    w_u, w_v, lift = records[r + W_U], records[r + W_V], records[r + LIFT] + light[ON_MAP + 8]
    red, green, blue = records[r + RGB], records[r + RGB + 1], records[r + RGB + 2]
    map_u, map_v = light[ON_MAP + 1] + light[ON_MAP + 3] * v, light[ON_MAP + 5] + light[ON_MAP + 7] * v
    map_d = light[ON_MAP + 9] + light[ON_MAP + 11] * v
    tall = (v - light[LENS + 2]) * light[LENS]
    tall = f32(1.0) + tall * tall
    table_row, texel_width, texel_height = i32(0), f32(1.0), f32(1.0)
    if texture >= 0:
        table_row = texture * i32(COLUMNS)
        texel_width, texel_height = ti.cast(table[table_row + WIDTH], f32), ti.cast(table[table_row + HEIGHT], f32)
    begin, block = i32(0), ti.cast(light[BLOCK], i32)
    while begin < count:
        end = ti.min(begin + block, count)
        air, air_u = f32(0.0), f32(0.0)
        if light[HAZE] > 0:
            wide = (u + ti.cast(begin, f32) - light[LENS + 1]) * light[LENS]
            wider = wide + ti.cast(end - begin, f32) * light[LENS]
            air = ti.sqrt(tall + wide * wide) * light[HAZE]
            air_u = (ti.sqrt(tall + wider * wider) * light[HAZE] - air) / ti.cast(end - begin, f32)
        texels_at, stride, most_u, most_v, size_u, size_v = i32(0), i32(0), i32(0), i32(0), f32(0.0), f32(0.0)
        if texture >= 0:
            x = left + ti.cast(begin, f32)
            z = f32(1.0) / depth_of(seen[at + begin])
            s, t = (s_row + s_u * x) * z, (t_row + t_u * x) * z
            step_s = high(ti.abs(s_u - s * w_u), ti.abs(s_v - s * w_v)) * z
            step_t = high(ti.abs(t_u - t * w_u), ti.abs(t_v - t * w_v)) * z
            across = level(step_s * texel_width, table[table_row + LEVELS_X])
            along = level(step_t * texel_height, table[table_row + LEVELS_Y])
            width = ti.max(table[table_row + WIDTH] >> across, i32(1))
            height = ti.max(table[table_row + HEIGHT] >> along, i32(1))
            texels_at, stride = table[table_row + AT + along * LEVELS + across], width + i32(2)
            most_u, most_v = (width << 8) + i32(255), (height << 8) + i32(255)
            size_u, size_v = ti.cast(width << 8, f32), ti.cast(height << 8, f32)
        for i in range(begin, end):
            step = ti.cast(i, f32)
            column, x = u + step, left + step
            z = f32(1.0) / depth_of(seen[at + i])
            sun, up = sun_row, up_row
            if varies:
                sun, up = (sun_row + sun_u * x) * z, (up_row + up_u * x) * z
            sky = light[AMBIENT] * (f32(0.75) + f32(0.25) * up)
            if sun > 0 and light[SUN] > 0:
                through = f32(1.0)
                if light[SHADOWED] != 0:
                    map_x = light[ON_MAP] + z * (map_u + light[ON_MAP + 2] * column)
                    map_y = light[ON_MAP + 4] + z * (map_v + light[ON_MAP + 6] * column)
                    near = lift + z * (map_d + light[ON_MAP + 10] * column)
                    through = sunlit(map_x, map_y, near, map_size, map_base, mark, shadow, opened)
                sky += light[SUN] * sun * through
            r0, g0, b0 = red * sky, green * sky, blue * sky
            if texture >= 0:
                s_at = place((s_row + s_u * x) * z, size_u, most_u)
                t_at = place((t_row + t_u * x) * z, size_v, most_v)
                lanes = sample(s_at, t_at, texels_at, stride, texels)
                r0 *= ti.cast(ti.cast(lanes & 0xFFFF, i32), f32) * f32(1 / 65280)
                g0 *= ti.cast(ti.cast((lanes >> 16) & 0xFFFF, i32), f32) * f32(1 / 65280)
                b0 *= ti.cast(ti.cast((lanes >> 32) & 0xFFFF, i32), f32) * f32(1 / 65280)
            if light[HAZE] > 0:
                clear = clear_air(z * (air + air_u * ti.cast(i - begin, f32)))
                r0 = light[HORIZON] + (r0 - light[HORIZON]) * clear
                g0 = light[HORIZON + 1] + (g0 - light[HORIZON + 1]) * clear
                b0 = light[HORIZON + 2] + (b0 - light[HORIZON + 2]) * clear
            put(first + i, pixel, out, r0, g0, b0, share, light, seed, line_base, tap, line, image)
            if ti.static(not tap):
                depth[out + first + i] = z
        begin = end


@ti.func
def shade_sky(
    first: i32, count: i32, u: f32, v: f32, share: f32, pixel: i32, out: i32, light, seed: i64, line_base: i32,
    tap: ti.template(), line: ti.template(), image: ti.template(), depth: ti.template(),
):  # fmt: skip
    """The same where there is only sky: the horizon's colour and the zenith's by the sine of the elevation."""
    tall = (v - light[LENS + 2]) * light[LENS]
    tall = f32(1.0) + tall * tall
    rise = light[CLIMB] + light[CLIMB + 2] * v
    begin, block = i32(0), ti.cast(light[BLOCK], i32)
    while begin < count:
        end = ti.min(begin + block, count)
        here, there = u + ti.cast(begin, f32), u + ti.cast(end, f32)
        wide, wider = (here - light[LENS + 1]) * light[LENS], (there - light[LENS + 1]) * light[LENS]
        sine = high((rise + light[CLIMB + 1] * here) / ti.sqrt(tall + wide * wide), f32(0.0))
        sine_u = high((rise + light[CLIMB + 1] * there) / ti.sqrt(tall + wider * wider), f32(0.0)) - sine
        sine_u /= ti.cast(end - begin, f32)
        for i in range(begin, end):
            up = sine + sine_u * ti.cast(i - begin, f32)
            red, green = light[HORIZON] + light[MORE] * up, light[HORIZON + 1] + light[MORE + 1] * up
            blue = light[HORIZON + 2] + light[MORE + 2] * up
            put(first + i, pixel, out, red, green, blue, share, light, seed, line_base, tap, line, image)
            if ti.static(not tap):
                depth[out + first + i] = f32(INFINITY)
        begin = end
