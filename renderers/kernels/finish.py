"""Rendered images to photos, in place, one worker a scene: a kernel each for colours and noise, blur and JPEG."""

from ..engine import ti
from .blur import blur
from .jpeg import compress
from .lanes import LANES
from .tone import JPEG, LATER, NOISE, NUM_COLUMNS, RADIUS, TONED, Colours, develop, read_bytes, tone_of

i32, f32 = ti.i32, ti.f32


@ti.kernel
def develop_images(
    blurred: ti.i32,
    workers: ti.i32,
    scenes: ti.i32,
    height: ti.i32,
    width: ti.i32,
    queue: ti.types.ndarray(ti.i32, 1),
    photos: ti.types.ndarray(ti.f64, 1),
    seeds: ti.types.ndarray(ti.i64, 1),
    image: ti.types.ndarray(ti.u8, 1),
    image_words: ti.types.ndarray(ti.u64, 1),
):
    """Change colours and add noise; where ``blurred``, add the noise that comes after a blur.

    ``queue`` holds zeros, ``image_words`` is ``image``.
    """
    for j in range(workers * ti.i32(512)):
        if j % 512 == 0:
            some, scene = Colours(), ti.atomic_add(queue[0], i32(1))
            while scene < scenes:
                photo, first = tone_of(scene, photos), scene * height * width
                changes, noise = photo[TONED], photo[NOISE]
                if blurred != 0:
                    changes, noise = f32(0.0), photo[LATER]
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
                scene = ti.atomic_add(queue[0], i32(1))


@ti.kernel
def blur_images(
    workers: ti.i32,
    scenes: ti.i32,
    height: ti.i32,
    width: ti.i32,
    room: ti.i32,
    reach: ti.i32,
    queue: ti.types.ndarray(ti.i32, 1),
    photos: ti.types.ndarray(ti.f64, 1),
    weights: ti.types.ndarray(ti.f32, 1),
    scratch: ti.types.ndarray(ti.f32, 1),
    image: ti.types.ndarray(ti.u8, 1),
):
    """Blur by ``weights (scenes, reach)``; ``scratch (workers, room)``; ``queue`` holds zeros."""
    for j in range(workers * ti.i32(512)):
        if j % 512 == 0:
            base, scene = ti.cast(j // 512, i32) * room, ti.atomic_add(queue[0], i32(1))
            while scene < scenes:
                radius = ti.cast(photos[scene * NUM_COLUMNS + RADIUS], i32)
                if radius > 0:
                    blur(scene * height * width, height, width, radius, scene * reach, base, weights, image, scratch)
                scene = ti.atomic_add(queue[0], i32(1))


@ti.kernel
def compress_images(
    workers: ti.i32,
    scenes: ti.i32,
    height: ti.i32,
    width: ti.i32,
    room: ti.i32,
    queue: ti.types.ndarray(ti.i32, 1),
    photos: ti.types.ndarray(ti.f64, 1),
    steps: ti.types.ndarray(ti.f32, 1),
    cosines: ti.types.ndarray(ti.f32, 1),
    scratch: ti.types.ndarray(ti.f32, 1),
    image: ti.types.ndarray(ti.u8, 1),
):
    """Take away what JPEG would; ``steps (scenes, 128)``, ``scratch (workers, room)``; ``queue`` holds zeros."""
    for j in range(workers * ti.i32(512)):
        if j % 512 == 0:
            base, scene = ti.cast(j // 512, i32) * room, ti.atomic_add(queue[0], i32(1))
            while scene < scenes:
                if photos[scene * NUM_COLUMNS + JPEG] != 0:
                    first = scene * height * width
                    compress(first, height, width, base, scene * i32(128), steps, cosines, image, scratch)
                scene = ti.atomic_add(queue[0], i32(1))
