"""The sprite kernel: painter's order with row spans, one worker a scene.

A position in a sprite is 64-bit fixed point with 32 fractional bits, of which the filter uses eight; the four channels
of a texel lie in the four 16-bit lanes of a 64-bit word, so that one multiplication weighs all of them. Images are
read and written in place: bytes, or where four opaque pixels lie aligned, three 32-bit words and one of four ids.
"""

from ..engine import ti

# Columns of the integer table, one row an instance: bounding box (y1 exclusive), position at the first pixel's centre,
# steps along a row and down a column, where its texels begin, tint in 1/256, node or -1, hard edges, even colour.
X0, Y0, X1, Y1, U, V, U_DX, V_DX, U_DY, V_DY, TEXEL, STRIDE, RED, GREEN, BLUE, NODE, HARD, EVEN = range(18)
INTEGERS = 18
# Columns of the real table: where the sprite may be seen, where it is opaque, where its edges are, all as positions;
# the edges' sharpness, columns for each step of position.
U_LO, V_LO, U_HI, V_HI, U_IN_LO, V_IN_LO, U_IN_HI, V_IN_HI = range(8)
U_START, V_START, U_END, V_END, U_SHARP, V_SHARP, PER_U, PER_V = range(8, 16)
REALS = 16
# Columns of the result, one row a node: extent and pixels of the silhouette, extent and pixels of the visible mask.
WHOLE, WHOLE_PIXELS, SEEN, SEEN_PIXELS, RESULTS = 0, 4, 5, 9, 10

ONE = 1 << 32
HALF_ALPHA = 255 * 128  # in a lane of a sample, which is 256 times the channel
BIG = 1 << 30
FAR = 1 << 29
LANES = 0x0001000100010001
SIGNS = 0x8000800080008000 - (1 << 64)
ROUND = 0x0080008000800080
BYTES = 0x00FF00FF00FF00FF

i64, u32, f64, u64 = ti.i64, ti.u32, ti.f64, ti.u64


@ti.func
def narrow(lo, hi, start: i64, per_step: f64, least: f64, most: f64):
    """The columns of ``lo..hi`` at which the position, ``start`` at column 0, lies within ``least..most``."""
    a, b = lo, hi
    at = ti.cast(start, f64)
    if per_step == 0:
        if at < least or at > most:
            b = a
    else:
        first, last = (least - at) * per_step, (most - at) * per_step
        if per_step < 0:
            first, last = last, first
        first, last = ti.min(ti.max(first, -FAR), FAR), ti.min(ti.max(last, -FAR), FAR)
        a = ti.max(a, BIG - ti.cast(BIG - first, i64))  # ceil and floor by truncation: the real ones are calls
        b = ti.min(b, ti.cast(BIG + last, i64) - BIG + 1)
    return a, ti.max(a, b)


@ti.func
def sample(texels: ti.template(), base: i64, stride: i64, u: i64, v: i64):
    """Bilinear sample; every lane is 256 times the channel, and exact at a texel's centre."""
    at = base + (v >> 32) * stride + (u >> 32)
    i, j = ti.cast(at, ti.i32), ti.cast(at + stride, ti.i32)
    fu, fv = ti.cast((u >> 24) & 255, u64), ti.cast((v >> 24) & 255, u64)
    near, right, down = texels[i], texels[i + 1] - texels[i], texels[j] - texels[i]
    twist = texels[j + 1] - texels[j] - right
    return (near << 8) + right * fu + down * fv + twist * ((fu * fv + 128) >> 8)


@ti.func
def opaque(texels: ti.template(), base, stride, u, v, red, green, blue):
    """An opaque pixel's tinted colour in three bytes, red the lowest."""
    s = sample(texels, base, stride, u, v)
    r = ti.cast(s & 0xFFFF, u32) * red + 32768
    g = ti.cast((s >> 16) & 0xFFFF, u32) * green + 32768
    b = ti.cast((s >> 32) & 0xFFFF, u32) * blue + 32768
    return (r >> 16) | ((g >> 8) & 0xFF00) | (b & 0xFF0000)


@ti.func
def on_texels(start: i64, step: i64, other: i64):
    """Whether positions from ``start`` on fall on texels' centres: steps of one texel, or of none."""
    return (start >> 24) & 255 == 0 and step == i64(ONE) and other == 0


@ti.func
def coverage(real: ti.template(), r, u: i64, v: i64):
    """How much of a pixel the hard edges of a magnified sprite leave, 0..256."""
    x, y = ti.cast(u, f64), ti.cast(v, f64)
    x = ti.min(x - real[r + U_START], real[r + U_END] - x) * real[r + U_SHARP] + 0.5
    y = ti.min(y - real[r + V_START], real[r + V_END] - y) * real[r + V_SHARP] + 0.5
    return ti.cast(ti.min(ti.max(x, 0.0), 1.0) * ti.min(ti.max(y, 0.0), 1.0) * 256.0 + 0.5, u64)


@ti.func
def paint_sprite(
    k, scene, height, width, nodes, coloured,
    whole: ti.template(), real: ti.template(), texels: ti.template(), colours: ti.template(), image: ti.template(),
    words: ti.template(), instance: ti.template(), quads: ti.template(), result: ti.template(),
):  # fmt: skip
    w, r = k * INTEGERS, k * REALS
    x0, y0 = whole[w + X0], whole[w + Y0]
    du, dv, per_u, per_v = whole[w + U_DX], whole[w + V_DX], real[r + PER_U], real[r + PER_V]
    base, stride, hard, node = whole[w + TEXEL], whole[w + STRIDE], whole[w + HARD] != 0, whole[w + NODE]
    red, green, blue = ti.cast(whole[w + RED], u32), ti.cast(whole[w + GREEN], u32), ti.cast(whole[w + BLUE], u32)
    label, labels = ti.cast(node + 1, ti.i16), (node + 1) * i64(LANES)
    has_inside = real[r + U_IN_LO] <= real[r + U_IN_HI] and real[r + V_IN_LO] <= real[r + V_IN_HI]
    even = whole[w + EVEN] != 0
    copied = red == 256 and green == 256 and blue == 256
    copied = copied and on_texels(whole[w + U], du, whole[w + U_DY]) and on_texels(whole[w + V], whole[w + V_DY], dv)
    colour = u32(0)
    if even:
        u, v = ti.cast(real[r + U_IN_HI], i64), ti.cast(real[r + V_IN_HI], i64)
        colour = opaque(texels, base, stride, u, v, red, green, blue)
    left, top, right, bottom, area = i64(BIG), i64(BIG), i64(-BIG), i64(-BIG), i64(0)

    for row in range(ti.cast(whole[w + Y1] - y0, ti.i32)):
        y = y0 + row
        u_row, v_row = whole[w + U] + whole[w + U_DY] * row, whole[w + V] + whole[w + V_DY] * row
        a, b = narrow(i64(0), whole[w + X1] - x0, u_row, per_u, real[r + U_LO], real[r + U_HI])
        a, b = narrow(a, b, v_row, per_v, real[r + V_LO], real[r + V_HI])
        inside, outside = b, b  # where the opaque part begins and ends
        if has_inside:
            inside, outside = narrow(a, b, u_row, per_u, real[r + U_IN_LO], real[r + U_IN_HI])
            inside, outside = narrow(inside, outside, v_row, per_v, real[r + V_IN_LO], real[r + V_IN_HI])
            if inside == outside:
                inside, outside = b, b
        on_canvas = 0 <= y and y < height
        line = (scene * height + ti.cast(y, ti.i32)) * width + ti.cast(x0, ti.i32)  # means nothing off the canvas
        row_left, row_right = i64(BIG), i64(-BIG)
        col = a
        while col < b:
            if col == inside:
                area += outside - inside
                row_left, row_right = ti.min(row_left, inside), outside
                c, end = ti.max(inside, -x0), ti.min(outside, width - x0)
                while on_canvas and c < end:
                    pixel = line + ti.cast(c, ti.i32)
                    u, v = u_row + du * c, v_row + dv * c
                    if pixel & 3 == 0 and c + 4 <= end:
                        quad = pixel >> 2
                        if coloured:
                            p0, p1, p2, p3 = colour, colour, colour, colour
                            if copied:
                                at = ti.cast(base + (v >> 32) * stride + (u >> 32), ti.i32)
                                p0, p1, p2, p3 = colours[at], colours[at + 1], colours[at + 2], colours[at + 3]
                            elif not even:
                                p0 = opaque(texels, base, stride, u, v, red, green, blue)
                                p1 = opaque(texels, base, stride, u + du, v + dv, red, green, blue)
                                p2 = opaque(texels, base, stride, u + 2 * du, v + 2 * dv, red, green, blue)
                                p3 = opaque(texels, base, stride, u + 3 * du, v + 3 * dv, red, green, blue)
                            words[3 * quad] = p0 | p1 << 24
                            words[3 * quad + 1] = p1 >> 8 | p2 << 16
                            words[3 * quad + 2] = p2 >> 16 | p3 << 8
                        quads[quad] = labels
                        c += 4
                    else:
                        if coloured:
                            rgb = opaque(texels, base, stride, u, v, red, green, blue)
                            for channel in ti.static(range(3)):
                                image[pixel * 3 + channel] = ti.cast(rgb >> (8 * channel), ti.u8)
                        instance[pixel] = label
                        c += 1
                col = outside
            else:
                u, v = u_row + du * col, v_row + dv * col
                s = sample(texels, base, stride, u, v)
                if hard:
                    s = (((s + u64(ROUND)) >> 8) & u64(BYTES)) * coverage(real, r, u, v)
                alpha = ti.cast(s >> 48, u32)
                if alpha != 0:
                    solid = alpha >= HALF_ALPHA
                    if solid:
                        area += 1
                        row_left, row_right = ti.min(row_left, col), col + 1
                    if on_canvas and 0 <= x0 + col and x0 + col < width:
                        pixel = line + ti.cast(col, ti.i32)
                        if coloured:
                            p = pixel * 3
                            # 65535 where the sprite is clear, 0 where it is opaque
                            rest = ((65280 - alpha) * 257 + 255) >> 8
                            c0 = ti.cast(s & 0xFFFF, u32) * red + ti.cast(image[p], u32) * rest
                            c1 = ti.cast((s >> 16) & 0xFFFF, u32) * green + ti.cast(image[p + 1], u32) * rest
                            c2 = ti.cast((s >> 32) & 0xFFFF, u32) * blue + ti.cast(image[p + 2], u32) * rest
                            image[p] = ti.cast((c0 + 32768) >> 16, ti.u8)
                            image[p + 1] = ti.cast((c1 + 32768) >> 16, ti.u8)
                            image[p + 2] = ti.cast((c2 + 32768) >> 16, ti.u8)
                        if solid:
                            instance[pixel] = label
                col += 1
        if row_left < row_right:
            left, right = ti.min(left, row_left + x0), ti.max(right, row_right + x0)
            top, bottom = ti.min(top, y), y + 1

    if area > 0 and node >= 0:
        t = (scene * nodes + ti.cast(node, ti.i32)) * RESULTS
        if result[t + WHOLE_PIXELS] > 0:  # another layer has drawn it too
            left, top = ti.min(left, result[t + WHOLE]), ti.min(top, result[t + WHOLE + 1])
            right, bottom = ti.max(right, result[t + WHOLE + 2]), ti.max(bottom, result[t + WHOLE + 3])
        result[t + WHOLE], result[t + WHOLE + 1] = left, top
        result[t + WHOLE + 2], result[t + WHOLE + 3] = right, bottom
        result[t + WHOLE_PIXELS] = result[t + WHOLE_PIXELS] + area


@ti.func
def none_zero(word):
    """Whether none of the four lanes is 0."""
    return (word - i64(LANES)) & ~word & i64(SIGNS) == 0


@ti.func
def see_node(t, node, scene, height, width, instance: ti.template(), quads: ti.template(), result: ti.template()):
    """Extent and pixels of the visible mask, by runs of four ids within the silhouette's extent."""
    label, labels = ti.cast(node + 1, ti.i16), (ti.cast(node, i64) + 1) * i64(LANES)
    x0, x1 = ti.cast(ti.max(result[t + WHOLE], 0), ti.i32), ti.cast(ti.min(result[t + WHOLE + 2], width), ti.i32)
    y0, y1 = ti.cast(ti.max(result[t + WHOLE + 1], 0), ti.i32), ti.cast(ti.min(result[t + WHOLE + 3], height), ti.i32)
    left, top, right, bottom, pixels = width, height, 0, 0, 0
    for y in range(y0, y1):
        line = (scene * height + y) * width
        row_left, row_right, x = width, 0, x0
        while x < x1:
            step, hits = 1, 0
            if (line + x) & 3 == 0:
                first, end = (line + x) >> 2, (line + x1) >> 2
                quad = first
                while quad < end and quads[quad] == labels:
                    quad += 1
                hits = (quad - first) * 4
                while hits == 0 and quad < end and none_zero(quads[quad] ^ labels):
                    quad += 1
                step = ti.max((quad - first) * 4, 1)
            if step == 1:
                hits = ti.cast(instance[line + x] == label, ti.i32)
            if hits > 0:
                row_left, row_right = ti.min(row_left, x), x + step
                pixels += hits
            x += step
        if row_left < row_right:
            left, right = ti.min(left, row_left), ti.max(right, row_right)
            top, bottom = ti.min(top, y), y + 1
    if pixels > 0:
        result[t + SEEN], result[t + SEEN + 1] = left, top
        result[t + SEEN + 2], result[t + SEEN + 3] = right, bottom
        result[t + SEEN_PIXELS] = pixels


@ti.kernel
def paint(
    workers: ti.i32,
    scenes: ti.i32,
    height: ti.i32,
    width: ti.i32,
    nodes: ti.i32,
    coloured: ti.i32,
    queue: ti.types.ndarray(ti.i32, 1),
    first: ti.types.ndarray(ti.i32, 1),
    whole: ti.types.ndarray(ti.i64, 1),
    real: ti.types.ndarray(ti.f64, 1),
    texels: ti.types.ndarray(ti.u64, 1),
    colours: ti.types.ndarray(ti.u32, 1),
    image: ti.types.ndarray(ti.u8, 1),
    words: ti.types.ndarray(ti.u32, 1),
    instance: ti.types.ndarray(ti.i16, 1),
    quads: ti.types.ndarray(ti.i64, 1),
    result: ti.types.ndarray(ti.i64, 1),
):
    """Paint every scene over what ``image`` holds; where it is not ``coloured``, ids and results alone.

    ``first (scenes + 1)`` says where the instances of each scene begin; ``words`` and ``quads`` are ``image`` and
    ``instance`` seen as 32-bit and 64-bit words; ``queue`` and ``result`` hold zeros.
    """
    for j in range(workers * ti.i32(512)):
        if j % 512 == 0:
            scene = ti.atomic_add(queue[0], 1)
            while scene < scenes:
                covers = coloured != 0  # what lies below all labels covers none
                for k in range(first[scene], first[scene + 1]):
                    covers = covers or whole[k * INTEGERS + NODE] >= 0
                    if covers:
                        paint_sprite(
                            k, scene, height, width, nodes, coloured != 0,
                            whole, real, texels, colours, image, words, instance, quads, result,
                        )  # fmt: skip
                for node in range(nodes):
                    t = (scene * nodes + node) * RESULTS
                    if result[t + WHOLE_PIXELS] > 0:
                        see_node(t, node, scene, height, width, instance, quads, result)
                scene = ti.atomic_add(queue[0], 1)
