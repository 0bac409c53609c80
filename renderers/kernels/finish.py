"""Rendered images to photos, in place, one worker a scene."""

from ..engine import ti
from .blur import blur
from .jpeg import compress
from .lanes import LANES
from .tone import JPEG, LATER, NOISE, RADIUS, TONED, Colours, develop, read_bytes, tone_of

i32, f32 = ti.i32, ti.f32


@ti.kernel
def finish(
    toned: ti.i32,
    workers: ti.i32,
    scenes: ti.i32,
    height: ti.i32,
    width: ti.i32,
    room: ti.i32,
    reach: ti.i32,
    queue: ti.types.ndarray(ti.i32, 1),
    photos: ti.types.ndarray(ti.f64, 1),
    seeds: ti.types.ndarray(ti.i64, 1),
    weights: ti.types.ndarray(ti.f32, 1),
    steps: ti.types.ndarray(ti.f32, 1),
    cosines: ti.types.ndarray(ti.f32, 1),
    scratch: ti.types.ndarray(ti.f32, 1),
    image: ti.types.ndarray(ti.u8, 1),
    image_words: ti.types.ndarray(ti.u64, 1),
):
    """Finish every image.

    ``toned`` is whether colours have been developed already, as a mesh's are; ``weights (scenes, reach)`` of blurs and
    ``steps (scenes, 128)`` of JPEG; ``scratch (workers, room)``; ``queue`` holds zeros, ``image_words`` is ``image``.
    """
    for j in range(workers * ti.i32(512)):
        if j % 512 == 0:
            base, some = ti.cast(j // 512, i32) * room, Colours()
            scene = ti.atomic_add(queue[0], i32(1))
            while scene < scenes:
                photo, first = tone_of(scene, photos), scene * height * width
                for stage in range(ti.select(toned != 0, i32(1), i32(0)), i32(2)):
                    changes, noise = photo[TONED], photo[NOISE]
                    if stage == 1:
                        changes, noise = f32(0.0), photo[LATER]
                        if photo[RADIUS] > 0:
                            radius = ti.cast(photo[RADIUS], i32)
                            blur(first, height, width, radius, scene * reach, base, weights, image, scratch)
                    if changes != 0 or noise > 0:
                        for row in range(height):
                            column, line = i32(0), first + row * width
                            while column < width:
                                at = line + column
                                count = ti.cast(ti.min(width - column, i32(LANES) - (at & i32(LANES - 1))), i32)
                                read_bytes(at, count, some, image, image_words)
                                develop(
                                    column, row, row * width + column, at, count, changes, noise, photo, seeds[scene],
                                    some, image, image_words,
                                )  # fmt: skip
                                column += count
                if photo[JPEG] != 0:
                    compress(first, height, width, base, scene * i32(128), steps, cosines, image, scratch)
                scene = ti.atomic_add(queue[0], i32(1))
