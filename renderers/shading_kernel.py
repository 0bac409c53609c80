"""Colours of what the visibility buffer holds, a run of pixels of one record at a time, and their bytes.

Light is added and multiplied in sRGB. A surface gets the sun's light by the cosine, where the shadow map lets it, and
the sky's: all of it if it faces upward, three quarters if upright, half if it faces down.
"""

from probscene.renderers import mesh_tables as tables
from probscene.renderers.engine import ti
from probscene.renderers.texture_atlas import AT, COLUMNS, HEIGHT, LEVELS, LEVELS_X, LEVELS_Y, WIDTH

# A record: the pixel at which its planes start; planes over the image, each a value and what a column and a row add, of
# both texture coordinates and of the cosines towards the sun and upward, divided by depth; 1/z's own steps; its colour.
FROM_U, FROM_V, PLANE_S, PLANE_T, PLANE_SUN, PLANE_UP, W_U, W_V, RGB, RECORD = 0, 1, 2, 5, 8, 11, 14, 15, 16, 19
# Its whole numbers: label or 0, class, texture or -1, whether the cosines vary.
LABEL, CLASS, IMAGE, VARIES, MARKS = range(5)

i32, i64, u32, u64, f32 = ti.i32, ti.i64, ti.u32, ti.u64, ti.f32
# What shading keeps of a scene in registers, and where.
LIT, SKY, AIR, MAPPED, AIR_RGB, LENS, MAP = 0, 1, 2, 3, 4, 7, 10
LIGHT = [tables.SUN, tables.AMBIENT, tables.HAZE, tables.SHADOWED]
LIGHT += [tables.HORIZON + i for i in range(3)] + [tables.FOCAL, tables.CENTRE, tables.CENTRE + 1]
LIGHT += [tables.ON_MAP + i for i in range(12)]


@ti.func
def lights(scene: i32, scenes: ti.template()):
    """``LIGHT`` of a scene."""
    s = scene * tables.SCENE
    return ti.Vector([ti.cast(scenes[s + column], f32) for column in ti.static(LIGHT)], dt=f32)


@ti.func
def depth_of(word: u64):
    """1/z in a word of the visibility buffer."""
    return ti.bit_cast(ti.cast(word >> 32, u32), f32)


@ti.func
def level(texels: f32, levels: i32):
    """The level at which steps of so many texels are nearest to one, on a scale of logarithms."""
    return ti.min(ti.max((ti.bit_cast(texels * f32(1.41421356), i32) >> 23) - 127, 0), levels - 1)


@ti.func
def place(coordinate: f32, size: i32):
    """A texture coordinate as a position in 1/256 of a texel of a framed level, of which 0 is the frame."""
    whole = ti.cast(coordinate, i64)
    rest = coordinate - ti.cast(whole, f32)
    if rest < 0:
        rest += f32(1.0)
    at = ti.cast(rest * ti.cast(size, f32) * f32(256.0), i32) + 128
    return ti.min(ti.max(at, 0), size * 256 + 255)


@ti.func
def sample(texture: i32, s: f32, t: f32, step_s: f32, step_t: f32, table: ti.template(), texels: ti.template()):
    """Bilinear sample where a pixel's steps are ``step_s`` and ``step_t``; three lanes, each 65280 times the share."""
    row = texture * COLUMNS
    x = level(step_s * ti.cast(table[row + WIDTH], f32), table[row + LEVELS_X])
    y = level(step_t * ti.cast(table[row + HEIGHT], f32), table[row + LEVELS_Y])
    width, height = ti.max(table[row + WIDTH] >> x, 1), ti.max(table[row + HEIGHT] >> y, 1)
    u, v = place(s, width), place(t, height)
    i = table[row + AT + y * LEVELS + x] + (v >> 8) * (width + 2) + (u >> 8)
    j = i + width + 2
    across, down = ti.cast(u & 255, u64), ti.cast(v & 255, u64)
    near, right, below = texels[i], texels[i + 1] - texels[i], texels[j] - texels[i]
    twist = texels[j + 1] - texels[j] - right
    return (near << 8) + right * across + below * down + twist * ((across * down + 128) >> 8)


@ti.func
def sunlit(column: f32, row: f32, near: f32, size: i32, base: i32, shadow: ti.template()):
    """Share of the four nearest texels of the shadow map that let the sun through, by their distance; 1 beyond it."""
    share = f32(1.0)
    if column >= 0 and row >= 0 and column < ti.cast(size - 1, f32) and row < ti.cast(size - 1, f32):
        i, j = ti.cast(column, i32), ti.cast(row, i32)
        across, down = column - ti.cast(i, f32), row - ti.cast(j, f32)
        at = base + j * size + i
        a, b = ti.cast(near >= shadow[at], f32), ti.cast(near >= shadow[at + 1], f32)
        c, d = ti.cast(near >= shadow[at + size], f32), ti.cast(near >= shadow[at + size + 1], f32)
        upper, lower = a + (b - a) * across, c + (d - c) * across
        share = upper + (lower - upper) * down
    return share


@ti.func
def clear_air(optical: f32):
    """exp(-x) within 0.002."""
    x = optical
    taylor = f32(1.0) + x * (f32(1.0) + x * (f32(1 / 2) + x * (f32(1 / 6) + x * (f32(1 / 24) + x * f32(1 / 120)))))
    return f32(1.0) / (taylor + x * x * x * x * x * x * f32(1 / 720))


@ti.func
def shade(
    record: i32, at: i32, first: i32, count: i32, u: f32, v: f32, share: f32, light, map_size: i32, map_base: i32,
    record_base: i32, mark_base: i32, line_base: i32,
    seen: ti.template(), shadow: ti.template(), records: ti.template(), marks: ti.template(), table: ti.template(),
    texels: ti.template(), line: ti.template(),
):  # fmt: skip
    """Add ``share`` of the colours of one record's pixels from column ``first``; the first one's sample is (u, v)."""
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
    w_u, w_v = records[r + W_U], records[r + W_V]
    red, green, blue = records[r + RGB] * share, records[r + RGB + 1] * share, records[r + RGB + 2] * share
    air_red, air_green, air_blue = light[AIR_RGB] * share, light[AIR_RGB + 1] * share, light[AIR_RGB + 2] * share
    map_u, map_v, map_d = light[MAP + 1], light[MAP + 5], light[MAP + 9]
    map_u, map_v, map_d = map_u + light[MAP + 3] * v, map_v + light[MAP + 7] * v, map_d + light[MAP + 11] * v
    lens, tall = f32(1.0) / light[LENS], (v - light[LENS + 2]) / light[LENS]
    tall = f32(1.0) + tall * tall
    for i in range(count):
        step = ti.cast(i, f32)
        column, x = u + step, left + step
        z = f32(1.0) / depth_of(seen[at + i])
        sun, up = sun_row, up_row
        if varies:
            sun, up = (sun_row + sun_u * x) * z, (up_row + up_u * x) * z
        sky = light[SKY] * (f32(0.75) + f32(0.25) * up)
        if sun > 0 and light[LIT] > 0:
            through = f32(1.0)
            if light[MAPPED] != 0:
                map_x = light[MAP] + z * (map_u + light[MAP + 2] * column)
                map_y = light[MAP + 4] + z * (map_v + light[MAP + 6] * column)
                near = light[MAP + 8] + z * (map_d + light[MAP + 10] * column)
                through = sunlit(map_x, map_y, near, map_size, map_base, shadow)
            sky += light[LIT] * sun * through
        r0, g0, b0 = red * sky, green * sky, blue * sky
        if texture >= 0:
            s, t = (s_row + s_u * x) * z, (t_row + t_u * x) * z
            step_s = ti.max(ti.abs(s_u - s * w_u), ti.abs(s_v - s * w_v)) * z
            step_t = ti.max(ti.abs(t_u - t * w_u), ti.abs(t_v - t * w_v)) * z
            lanes = sample(texture, s, t, step_s, step_t, table, texels)
            r0 *= ti.cast(ti.cast(lanes & 0xFFFF, i32), f32) * f32(1 / 65280)
            g0 *= ti.cast(ti.cast((lanes >> 16) & 0xFFFF, i32), f32) * f32(1 / 65280)
            b0 *= ti.cast(ti.cast((lanes >> 32) & 0xFFFF, i32), f32) * f32(1 / 65280)
        if light[AIR] > 0:
            wide = (column - light[LENS + 1]) * lens
            clear = clear_air(light[AIR] * z * ti.sqrt(tall + wide * wide))
            r0, g0 = air_red + (r0 - air_red) * clear, air_green + (g0 - air_green) * clear
            b0 = air_blue + (b0 - air_blue) * clear
        p = line_base + 3 * (first + i)
        line[p], line[p + 1], line[p + 2] = line[p] + r0, line[p + 1] + g0, line[p + 2] + b0


@ti.func
def shade_sky(
    scene: i32, first: i32, count: i32, u: f32, v: f32, share: f32, light, line_base: i32,
    scenes: ti.template(), line: ti.template(),
):  # fmt: skip
    """The same where there is only sky: the horizon's colour and the zenith's by the sine of the elevation."""
    s = scene * tables.SCENE
    lens, tall = f32(1.0) / light[LENS], (v - light[LENS + 2]) / light[LENS]
    tall = f32(1.0) + tall * tall
    climb = ti.cast(scenes[s + tables.RAY + 7], f32)
    rise = ti.cast(scenes[s + tables.RAY + 6], f32) + ti.cast(scenes[s + tables.RAY + 8], f32) * v
    red, green, blue = light[AIR_RGB] * share, light[AIR_RGB + 1] * share, light[AIR_RGB + 2] * share
    more_red = ti.cast(scenes[s + tables.ZENITH], f32) * share - red
    more_green = ti.cast(scenes[s + tables.ZENITH + 1], f32) * share - green
    more_blue = ti.cast(scenes[s + tables.ZENITH + 2], f32) * share - blue
    for i in range(count):
        column = u + ti.cast(i, f32)
        wide = (column - light[LENS + 1]) * lens
        sine = ti.max((rise + climb * column) / ti.sqrt(tall + wide * wide), f32(0.0))
        p = line_base + 3 * (first + i)
        line[p] = line[p] + red + more_red * sine
        line[p + 1] = line[p + 1] + green + more_green * sine
        line[p + 2] = line[p + 2] + blue + more_blue * sine


@ti.func
def scatter(seed: i64, pixel: i32):
    """64 bits of an image's pixel (a mix after Steele, Lea and Flood 2014)."""
    x = ti.cast(seed, u64) * u64(0x1E3779B97F4A7C15) + ti.cast(pixel, u64) * u64(0x3C6EF372FE94F82B)
    x = (x ^ (x >> 30)) * u64(0x3F58476D1CE4E5B9)
    x = (x ^ (x >> 27)) * u64(0x14D049BB133111EB)
    return x ^ (x >> 31)


@ti.func
def bell(bits: u64):
    """About normal, of mean 0 and variance 1: three of seven bits added up."""
    total = (bits & 127) + ((bits >> 7) & 127) + ((bits >> 14) & 127)
    return (ti.cast(ti.cast(total, i32), f32) - f32(190.5)) * f32(0.015625)


@ti.func
def byte(value: f32):
    return ti.cast(ti.min(ti.max(value * f32(255.0) + f32(0.5), f32(0.0)), f32(255.0)), u32)


@ti.func
def develop(
    scene: i32, row: i32, height: i32, width: i32, line_base: i32, row_base: i32,
    scenes: ti.template(), seeds: ti.template(), line: ti.template(), packed: ti.template(),
    image: ti.template(), words: ti.template(),
):  # fmt: skip
    """A row's colours to bytes, and clear them; four pixels are three words where they lie aligned."""
    s = scene * tables.SCENE
    changed, seed = scenes[s + tables.DEVELOPED] != 0, seeds[scene]
    noise = ti.cast(scenes[s + tables.NOISE], f32) / f32(255.0)
    matrix = ti.Vector([ti.cast(scenes[s + tables.MATRIX + i], f32) for i in range(9)], dt=f32)
    bias = ti.cast(scenes[s + tables.BIAS], f32)
    for x in range(width):
        p = line_base + 3 * x
        red, green, blue = line[p], line[p + 1], line[p + 2]
        line[p], line[p + 1], line[p + 2] = f32(0.0), f32(0.0), f32(0.0)
        if changed:
            r = matrix[0] * red + matrix[1] * green + matrix[2] * blue + bias
            g = matrix[3] * red + matrix[4] * green + matrix[5] * blue + bias
            blue = matrix[6] * red + matrix[7] * green + matrix[8] * blue + bias
            red, green = r, g
        if noise > 0:
            bits = scatter(seed, row * width + x)
            red, green = red + noise * bell(bits), green + noise * bell(bits >> 21)
            blue += noise * bell(bits >> 42)
        packed[row_base + x] = byte(red) | byte(green) << 8 | byte(blue) << 16
    start = (scene * height + row) * width
    x = i32(0)
    while x < width:
        pixel, at = start + x, row_base + x
        if pixel & 3 == 0 and x + 4 <= width:
            a, b, c, d = packed[at], packed[at + 1], packed[at + 2], packed[at + 3]
            word = 3 * (pixel >> 2)
            words[word], words[word + 1], words[word + 2] = a | b << 24, b >> 8 | c << 16, c >> 16 | d << 8
            x += 4
        else:
            for channel in ti.static(range(3)):
                image[3 * pixel + channel] = ti.cast(packed[at] >> (8 * channel), ti.u8)
            x += 1
