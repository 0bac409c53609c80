"""The mesh kernel: worlds to images and labels, one worker a scene.

A scene is drawn in three steps: instances into the visibility buffer, their shadows into the shadow map, and then each
row gets the ground and is labelled, shaded and cleared for the next scene.
"""

from ...engine import ti
from ...kernels.lanes import LANES, floats, whole_lanes, words
from ...kernels.tone import NOISE, TONED, develop, tone_of
from ..tables import layout
from . import shading
from .geometry import draw_instance, lay_ground, unstamp
from .raster import lay_row, strip_row
from .rows import add_colours, add_samples, clear, compare, label, read_ground, read_pixels, repeat_last, take_colours
from .samples import Samples
from .shading import shade
from .shadows import SPARE, cast_shadow, open_tiles

i32, u64, f32, f64 = ti.i32, ti.u64, ti.f32, ti.f64


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
    photos: ti.types.ndarray(ti.f64, 1),
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
    stamp: ti.types.ndarray(ti.u64, 1),
    shadow: ti.types.ndarray(ti.f32, 1),
    opened: ti.types.ndarray(ti.i32, 1),
    corners: ti.types.ndarray(ti.f64, 1),
    records: ti.types.ndarray(ti.f32, 1),
    marks: ti.types.ndarray(ti.i32, 1),
    line: ti.types.ndarray(ti.f32, 1),
    bounds: ti.types.ndarray(ti.i32, 1),
    image: ti.types.ndarray(ti.u8, 1),
    instance: ti.types.ndarray(ti.i16, 1),
    semantic: ti.types.ndarray(ti.u8, 1),
    depth: ti.types.ndarray(ti.f32, 1),
    seen_blocks: ti.types.ndarray(words, 1),
    shadow_words: ti.types.ndarray(ti.u64, 1),
    image_words: ti.types.ndarray(ti.u64, 1),
    instance_words: ti.types.ndarray(ti.u64, 1),
    semantic_words: ti.types.ndarray(ti.u64, 1),
    depth_words: ti.types.ndarray(ti.u64, 1),
    result: ti.types.ndarray(ti.i32, 1),
    extent: ti.types.ndarray(ti.f64, 1),
):
    """Render every scene.

    ``fine`` is whether there are four samples a pixel, kept behind the visibility buffer's first part. ``first (scenes
    + 1)`` says where the instances of each scene begin; ``seen`` to ``bounds`` are scratch, as much for each worker, of
    which ``seen``, ``stamp``, ``opened`` and ``line`` hold zeros, as ``queue`` does; ``result`` and ``extent``
    empty extents. Those named words and blocks are the same memory as what they are of.
    """
    for j in range(workers * ti.i32(512)):
        if j % 512 == 0:
            worker = ti.cast(j // 512, i32)
            pixels = height * width
            room = whole_lanes(pixels + i32(2 * LANES))  # the first block may begin late, and spans end late
            seen_base = worker * room * ti.static(5 if fine else 1)
            stamp_base = worker * height * ((width + 63) >> 6)
            map_base, corner_base = worker * (map_size * map_size + i32(SPARE)), worker * most_vertices * 5
            record_base, mark_base = worker * most_records * shading.RECORD, worker * most_records * shading.MARKS
            line_base, bounds_base = worker * width * 3, worker * 2 * ti.max(strips, 1)
            some, share = Samples(), floats(0)
            scene = ti.atomic_add(queue[0], i32(1))
            while scene < scenes:
                laid = ti.select(scene_table[scene * layout.SCENE + layout.GROUNDED] != 0, strips, 0)
                lay_ground(
                    scene, laid, record_base, mark_base, 0.5 * ti.cast(width, f64), 0.5 * ti.cast(height, f64),
                    scene_table, strip, tiles, records, marks,
                )  # fmt: skip
                base = seen_base + (scene * pixels & i32(LANES - 1))  # blocks begin where the images' do
                texel = scene_table[scene * layout.SCENE + layout.TEXEL]
                last, stamped = laid, i32(-1)
                for k in range(first[scene], first[scene + 1]):
                    node = ti.cast(whole[k * layout.INTEGERS + layout.NODE], i32)
                    target = ti.select(node < 0, i32(-1), scene * nodes + node)
                    if target != stamped:
                        if stamped >= 0:
                            unstamp(stamped, height, width, stamp_base, extent, stamp)
                        stamped = target
                    if node >= 0 or whole[k * layout.INTEGERS + layout.SEEN] != 0:
                        last, area = draw_instance(
                            k, last, target, height, width, ti.static(2 if fine else 1), base, seen_base + room,
                            stamp_base, corner_base, record_base, mark_base, texel, whole, real, positions, triangles,
                            faces, seen, shadow, stamp, corners, records, marks, extent,
                        )  # fmt: skip
                        if node >= 0:
                            total = target * layout.RESULTS + layout.WHOLE
                            result[total] = result[total] + area
                if stamped >= 0:
                    unstamp(stamped, height, width, stamp_base, extent, stamp)
                if scene_table[scene * layout.SCENE + layout.LIGHT + layout.SHADOWED] != 0:
                    for k in range(first[scene], first[scene + 1]):
                        open_tiles(k, scene + 1, map_size, map_base, whole, shadow, shadow_words, opened)
                    for k in range(first[scene], first[scene + 1]):
                        if whole[k * layout.INTEGERS + layout.CASTS] != 0:
                            cast_shadow(
                                k, map_size, map_base, corner_base, whole, real, positions, triangles, seen, shadow,
                                corners,
                            )  # fmt: skip
                light, photo = shading.lights(scene, scene_table), tone_of(scene, photos)
                for row in range(height):
                    pixel, line_at = row * width, base + row * width
                    out, fine_at = scene * pixels + pixel, seen_base + room + i32(4) * pixel
                    if ti.static(fine):
                        lay_row(
                            scene, laid, row, width, line_at, 1.0, 0.0, bounds_base, scene_table, edges, bounds, seen
                        )
                        for half in range(2):
                            lay_row(
                                scene, laid, 2 * row + half, 2 * width, fine_at + 2 * width * half, 0.5, -0.25,
                                bounds_base, scene_table, edges, bounds, seen,
                            )  # fmt: skip
                        filled = i32(0)
                        for x in range(width):
                            filled = add_samples(x, row, filled, width, line_at, fine_at, seen, some, share)
                            if filled > LANES - 4 or x == width - 1:
                                repeat_last(filled, some)
                                compare(some)
                                shade(
                                    light, map_size, map_base, scene + 1, record_base, mark_base, records, marks,
                                    textures, texels, shadow, opened, some,
                                )  # fmt: skip
                                add_colours(filled, line_base, some, share, line)
                                filled = i32(0)
                        clear(fine_at, 4 * width, seen)
                    column = i32(0)
                    w, w_u = strip_row(scene, laid, row, width, 1.0, 0.0, bounds_base, scene_table, edges, bounds)
                    while column < width:
                        count = ti.cast(ti.min(width - column, i32(LANES) - (line_at + column & i32(LANES - 1))), i32)
                        read_pixels(column, row, count, line_at + column, seen, seen_blocks, some)
                        read_ground(column, count, laid, w, w_u, bounds_base, bounds, some)
                        compare(some)
                        label(
                            column, row, count, out + column, scene * nodes, mark_base, some, marks, instance, semantic,
                            depth, instance_words, semantic_words, depth_words, result,
                        )  # fmt: skip
                        if ti.static(fine):
                            take_colours(column, count, line_base, some, line)
                        else:
                            shade(
                                light, map_size, map_base, scene + 1, record_base, mark_base, records, marks, textures,
                                texels, shadow, opened, some,
                            )  # fmt: skip
                        develop(
                            column, row, pixel + column, out + column, count, photo[TONED], photo[NOISE], photo,
                            seeds[scene], some, image, image_words,
                        )  # fmt: skip
                        column += count
                scene = ti.atomic_add(queue[0], i32(1))
