"""The mesh kernel: worlds to images and labels, one worker a scene.

A scene is drawn in four steps, each over scratch that stays in the cache: the ground clears the visibility buffer,
instances are drawn into it, their shadows into the shadow map, and then the rows are labelled and shaded.
"""

from probscene.renderers import mesh_tables as tables
from probscene.renderers import shading_kernel as shading
from probscene.renderers.engine import ti
from probscene.renderers.geometry_kernel import draw_instance, lay_ground
from probscene.renderers.photo_kernel import develop
from probscene.renderers.raster_kernel import fill_ground
from probscene.renderers.shadow_kernel import cast_shadow, open_tiles

i32, u32, u64, f32, f64 = ti.i32, ti.u32, ti.u64, ti.f32, ti.f64


@ti.func
def record_of(word: u64):
    return ti.cast(ti.cast(word, u32), i32)


@ti.func
def run_end(x: i32, width: i32, line: i32, record: i32, seen: ti.template()):
    """The first column after ``x`` of another record."""
    end = x + i32(1)
    while end < width and record_of(seen[line + end]) == record:
        end += i32(1)
    return end


@ti.func
def even(x: i32, line: i32, fine: i32, width: i32, record: i32, seen: ti.template()):
    """Whether a pixel and its four samples are of one record."""
    at = fine + 2 * x
    same = record_of(seen[line + x]) == record and record_of(seen[at]) == record
    same = same and record_of(seen[at + 1]) == record and record_of(seen[at + 2 * width]) == record
    return same and record_of(seen[at + 2 * width + 1]) == record


@ti.func
def label_run(
    record: i32, x: i32, end: i32, out: i32, row: i32, first_node: i32, mark_base: i32, marks: ti.template(),
    instance: ti.template(), semantic: ti.template(), result: ti.template(),
):  # fmt: skip
    """Ids and classes of the columns of one record, and its node's extent and count."""
    label, kind = i32(0), i32(0)
    if record > 0:
        label = marks[mark_base + record * shading.MARKS + shading.LABEL]
        kind = marks[mark_base + record * shading.MARKS + shading.CLASS]
    id16, kind8 = ti.cast(label, ti.i16), ti.cast(kind, ti.u8)
    for i in range(x, end):
        instance[out + i] = id16
        semantic[out + i] = kind8
    if label > 0:
        t = (first_node + label - 1) * tables.RESULTS
        result[t + tables.BOX] = ti.min(result[t + tables.BOX], x)
        result[t + tables.BOX + 1] = ti.min(result[t + tables.BOX + 1], row)
        result[t + tables.BOX + 2] = ti.max(result[t + tables.BOX + 2], end)
        result[t + tables.BOX + 3] = row + i32(1)
        result[t + tables.PIXELS] = result[t + tables.PIXELS] + end - x


@ti.func
def label_row(
    out: i32, row: i32, first_node: i32, width: i32, line: i32, mark_base: i32,
    seen: ti.template(), marks: ti.template(), instance: ti.template(), semantic: ti.template(), depth: ti.template(),
    result: ti.template(),
):  # fmt: skip
    """Ids, classes and depth of a row."""
    x = i32(0)
    while x < width:
        record = record_of(seen[line + x])
        end = run_end(x, width, line, record, seen)
        label_run(record, x, end, out, row, first_node, mark_base, marks, instance, semantic, result)
        for i in range(x, end):
            depth[out + i] = f32(1.0) / shading.depth_of(seen[line + i])  # infinity in the sky
        x = end


@ti.kernel
def render(
    fine: ti.template(),
    workers: ti.i32,
    scenes: ti.i32,
    height: ti.i32,
    width: ti.i32,
    nodes: ti.i32,
    strips: ti.i32,
    map_size: ti.i32,
    most_vertices: ti.i32,
    most_records: ti.i32,
    queue: ti.types.ndarray(ti.i32, 1),
    first: ti.types.ndarray(ti.i32, 1),
    whole: ti.types.ndarray(ti.i64, 1),
    real: ti.types.ndarray(ti.f64, 1),
    scene_table: ti.types.ndarray(ti.f64, 1),
    seeds: ti.types.ndarray(ti.i64, 1),
    edges: ti.types.ndarray(ti.f64, 1),
    strip: ti.types.ndarray(ti.i32, 1),
    tiles: ti.types.ndarray(ti.f64, 1),
    positions: ti.types.ndarray(ti.f32, 1),
    triangles: ti.types.ndarray(ti.i32, 1),
    faces: ti.types.ndarray(ti.f32, 1),
    textures: ti.types.ndarray(ti.i32, 1),
    texels: ti.types.ndarray(ti.u64, 1),
    seen: ti.types.ndarray(ti.u64, 1),
    stamp: ti.types.ndarray(ti.i32, 1),
    shadow: ti.types.ndarray(ti.f32, 1),
    opened: ti.types.ndarray(ti.i32, 1),
    corners: ti.types.ndarray(ti.f64, 1),
    records: ti.types.ndarray(ti.f32, 1),
    marks: ti.types.ndarray(ti.i32, 1),
    line: ti.types.ndarray(ti.f32, 1),
    image: ti.types.ndarray(ti.u8, 1),
    instance: ti.types.ndarray(ti.i16, 1),
    semantic: ti.types.ndarray(ti.u8, 1),
    depth: ti.types.ndarray(ti.f32, 1),
    result: ti.types.ndarray(ti.i32, 1),
    extent: ti.types.ndarray(ti.f64, 1),
):
    """Render every scene.

    ``fine`` is whether there are four samples a pixel, kept behind the visibility buffer's first part. ``first (scenes
    + 1)`` says where the instances of each scene begin; ``seen`` to ``line`` are scratch, as much for each worker, of
    which ``stamp``, ``opened`` and ``line`` hold zeros, as ``queue`` does; ``result`` and ``extent`` empty extents.
    """
    for j in range(workers * ti.i32(512)):
        if j % 512 == 0:
            worker = ti.cast(j // 512, i32)
            pixels = height * width
            base, stamp_base = worker * pixels * ti.static(5 if fine else 1), worker * pixels
            map_base, corner_base = worker * map_size * map_size, worker * most_vertices * 5
            record_base, mark_base = worker * most_records * shading.RECORD, worker * most_records * shading.MARKS
            line_base = worker * width * 3
            scene = ti.atomic_add(queue[0], i32(1))
            while scene < scenes:
                laid = ti.select(scene_table[scene * tables.SCENE + tables.GROUNDED] != 0, strips, 0)
                lay_ground(
                    scene, laid, record_base, mark_base, 0.5 * ti.cast(width, f64), 0.5 * ti.cast(height, f64),
                    scene_table, strip, tiles, records, marks,
                )  # fmt: skip
                for zoom in range(i32(1), i32(ti.static(3 if fine else 2))):
                    fill_ground(
                        scene, laid, height * zoom, width * zoom, base + (zoom - 1) * pixels,
                        1 / ti.cast(zoom, f64), -0.25 * ti.cast(zoom - 1, f64), scene_table, edges, seen,
                    )  # fmt: skip
                texel = scene_table[scene * tables.SCENE + tables.TEXEL]
                last, mark, marked = laid, i32(0), i32(-1)
                for k in range(first[scene], first[scene + 1]):
                    node = ti.cast(whole[k * tables.INTEGERS + tables.NODE], i32)
                    if node < 0:
                        mark = i32(0)
                    elif node != marked:
                        mark, marked = k + i32(1), node
                    if node >= 0 or whole[k * tables.INTEGERS + tables.SEEN] != 0:
                        target = ti.select(node < 0, -1, scene * nodes + node)
                        last, area = draw_instance(
                            k, mark, last, target, height, width, ti.static(2 if fine else 1), base, stamp_base,
                            corner_base, record_base, mark_base, texel, whole, real, positions, triangles, faces,
                            seen, stamp, corners, records, marks, extent,
                        )  # fmt: skip
                        if node >= 0:
                            total = target * tables.RESULTS + tables.WHOLE
                            result[total] = result[total] + area
                if scene_table[scene * tables.SCENE + tables.LIGHT + tables.SHADOWED] != 0:
                    for k in range(first[scene], first[scene + 1]):
                        open_tiles(k, scene + 1, map_size, map_base, whole, shadow, opened)
                    for k in range(first[scene], first[scene + 1]):
                        if whole[k * tables.INTEGERS + tables.CASTS] != 0:
                            cast_shadow(
                                k, map_size, map_base, corner_base, whole, real, positions, triangles, shadow, corners
                            )
                light = shading.lights(scene, scene_table)
                for row in range(height):
                    pixel, line_at = row * width, base + row * width
                    out, x, v = scene * pixels + pixel, i32(0), ti.cast(row, f32)
                    if ti.static(fine):
                        fine_at, tap = base + pixels + i32(4) * pixel, i32(0)
                        label_row(
                            out, row, scene * nodes, width, line_at, mark_base, seen, marks, instance, semantic, depth,
                            result,
                        )  # fmt: skip
                        while x < width:
                            record, end, at = record_of(seen[line_at + x]), x, line_at + x
                            u, share = ti.cast(x, f32), f32(1.0)
                            v = ti.cast(row, f32)
                            while tap == 0 and end < width and even(end, line_at, fine_at, width, record, seen):
                                end += i32(1)
                            if end == x:  # its four samples, one after another
                                across, down = tap & i32(1), tap >> 1
                                at = fine_at + x + x + across + down * (width + width)
                                record, share = record_of(seen[at]), f32(0.25)
                                u += f32(0.5) * ti.cast(across, f32) - f32(0.25)
                                v += f32(0.5) * ti.cast(down, f32) - f32(0.25)
                                tap = (tap + i32(1)) & i32(3)
                                end = x + ti.cast(tap == 0, i32)
                            count = ti.max(end - x, i32(1))
                            if record == 0:
                                shading.shade_sky(
                                    x, count, u, v, share, pixel, out, light, seeds[scene], line_base, True, line,
                                    image, depth,
                                )  # fmt: skip
                            else:
                                shading.shade(
                                    record, at, x, count, u, v, share, pixel, out, light, seeds[scene], map_size,
                                    map_base, scene + 1, record_base, mark_base, line_base, True, seen, shadow, opened,
                                    records, marks, textures, texels, line, image, depth,
                                )  # fmt: skip
                            x = end
                        for column in range(width):
                            p = line_base + 3 * column
                            develop(
                                pixel + column, out + column, line[p], line[p + 1], line[p + 2], light, seeds[scene],
                                image,
                            )  # fmt: skip
                            line[p], line[p + 1], line[p + 2] = f32(0.0), f32(0.0), f32(0.0)
                    else:
                        while x < width:
                            record = record_of(seen[line_at + x])
                            end, u = run_end(x, width, line_at, record, seen), ti.cast(x, f32)
                            label_run(
                                record, x, end, out, row, scene * nodes, mark_base, marks, instance, semantic, result
                            )
                            if record == 0:
                                shading.shade_sky(
                                    x, end - x, u, v, f32(1.0), pixel, out, light, seeds[scene], line_base, False, line,
                                    image, depth,
                                )  # fmt: skip
                            else:
                                shading.shade(
                                    record, line_at + x, x, end - x, u, v, f32(1.0), pixel, out, light, seeds[scene],
                                    map_size, map_base, scene + 1, record_base, mark_base, line_base, False, seen,
                                    shadow, opened, records, marks, textures, texels, line, image, depth,
                                )  # fmt: skip
                            x = end
                scene = ti.atomic_add(queue[0], i32(1))
