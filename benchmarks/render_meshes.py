"""CPU time of rendering streets of meshes, against moderngl on Mesa's llvmpipe and the time to write the bytes.

    python benchmarks/render_meshes.py --scenes 32 --repeats 5

30 objects a scene, 14,000 triangles, a third of them textured, all with smooth normals; ground in seven strips, sun
with a shadow map, haze. The peer draws the same triangles by the same matrices into an image, an id buffer and a depth
buffer, back faces culled, shadows from a map of the same size with 2 x 2 samples, and reads all three back; its lists
of what to draw are prepared outside the time, and it finds no boxes, counts or silhouettes, the renderer does. "fill"
writes the bytes of image, ids, classes and depth into fresh memory. Figures are CPU milliseconds an image over all
threads, the least of interleaved repeats; "ids" is the share of pixels at which the two ids differ.
"""

import argparse
import importlib.util
import os
import time
from collections.abc import Callable

import numpy as np
import torch

from probscene.camera_effects import CameraEffects
from probscene.mesh import Mesh, Surface
from probscene.renderers.meshes import MeshRenderer
from probscene.threads import use_threads
from probscene.world import Camera, Ground, Light, Meshes, World, resolve_ground, resolve_meshes, resolve_scene

OBJECTS = 30
EDGES = (-9.0, -3.6, -0.1, 0.1, 3.6, 9.0)
CHOICE = (1, 2, 0, 3, 0, 2, 1)


def body(length, width, height, power, columns=18, rows=14, texture=None) -> Mesh:
    """A rounded block of 468 triangles."""
    around, up = np.arange(columns) * 2 * np.pi / columns, np.arange(1, rows) * np.pi / rows - np.pi / 2

    def bent(value):
        return np.sign(value) * np.abs(value) ** power

    ring = np.stack([bent(np.cos(around)), bent(np.sin(around))], 1)
    size = np.array([length / 2, width / 2, height / 2])
    points = [np.array([*(corner * bent(np.cos(angle))), bent(np.sin(angle))]) for angle in up for corner in ring]
    points = np.array([*points, [0, 0, -1], [0, 0, 1]])
    normals = points / size
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    bottom, triangles = len(points) - 2, []
    for i in range(columns):
        j = (i + 1) % columns
        triangles += [(bottom, j, i), (bottom + 1, (rows - 2) * columns + i, (rows - 2) * columns + j)]
        for k in range(rows - 2):
            a, b, c, d = k * columns + i, k * columns + j, (k + 1) * columns + i, (k + 1) * columns + j
            triangles += [(a, b, d), (a, d, c)]
    triangles = np.array(triangles)
    uv = (points[triangles][..., [0, 2]] + 1) * 2
    return Mesh(points * size + [0, 0, size[2]], triangles, (220, 215, 210), None, normals[triangles], uv, texture)


def noise(generator, colour, size=128) -> np.ndarray:
    return np.clip(np.array(colour) + generator.normal(0, 14, (size, size, 1)), 0, 255).astype(np.uint8)


def streets(scenes: int, canvas: tuple[int, int]) -> World:
    """30 objects in front of a camera over a road."""
    generator = np.random.default_rng(0)
    shape = scenes, OBJECTS
    panes = np.kron(generator.integers(60, 255, (8, 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    meshes = body(4.2, 1.8, 1.5, 0.5), body(0.6, 0.6, 1.8, 1.0), body(6, 6, 7, 0.3, texture=panes)
    x = generator.uniform(8, 60, shape)
    columns = {
        "mesh": generator.integers(0, 3, shape),
        "x": x,
        "y": generator.uniform(-0.7, 0.7, shape) * x,
        "yaw": generator.uniform(-3, 3, shape),
        "tint": generator.uniform(0.4, 1, (*shape, 3)),
    }
    layer = Meshes("thing", meshes, **{name: torch.from_numpy(value) for name, value in columns.items()})
    colours = {"road": (100, 100, 104), "grass": (85, 120, 60), "path": (150, 145, 140), "marking": (225, 225, 225)}
    surfaces = tuple(Surface(name, noise(generator, colour), (4.0, 4.0)) for name, colour in colours.items())
    ground = Ground(surfaces, torch.tensor([EDGES]), torch.tensor([CHOICE]))
    return World(
        torch.zeros(shape, dtype=torch.int64),
        ("thing",),
        (resolve_meshes(layer, torch.ones(shape, dtype=torch.bool)),),
        resolve_scene(Camera.kitti(canvas), scenes),
        resolve_scene(Light(), scenes),
        resolve_ground(ground, scenes),
        resolve_scene(CameraEffects(), scenes),
    )


def floor(scenes: int, canvas: tuple[int, int]) -> None:
    """Write the bytes of images, ids, classes and depth into fresh memory."""
    np.empty((scenes, *canvas, 3), np.uint8).fill(1)
    np.empty((scenes, *canvas), np.int16).fill(1)
    np.empty((scenes, *canvas), np.uint8).fill(1)
    np.empty((scenes, *canvas), np.float32).fill(1)


def least(runs: dict[str, Callable], repeats: int, scenes: int) -> dict[str, float]:
    """CPU milliseconds an image of each, interleaved."""
    times = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.process_time()
            run()
            times[name].append((time.process_time() - start) * 1000 / scenes)
    return {name: min(values) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--pictures", help="a folder for the first scene as both draw it")
    arguments = parser.parse_args()
    if importlib.util.find_spec("moderngl") is None:
        print("Skipped: expected moderngl, got none; make benchmark installs it.")
        return
    from opengl_peer import Peer

    os.environ["LP_NUM_THREADS"] = str(arguments.threads if arguments.threads > 1 else 0)
    use_threads(arguments.threads)
    scenes = arguments.scenes
    print(f"CPU ms an image, {scenes} scenes of {OBJECTS} objects, {arguments.threads} threads")
    heads = ("probscene", "4 samples", "OpenGL", "fill", "OpenGL /", "/ fill", "ids")
    print("canvas  ", *(f"{head:>9}" for head in heads))
    for canvas in ((375, 1242), (188, 621), (94, 310)):
        world = streets(scenes, canvas)
        renderer, smooth = (MeshRenderer(canvas, arguments.threads, samples) for samples in (1, 4))
        peer = Peer(world, canvas, renderer.map_size)
        runs = {
            "ours": lambda renderer=renderer, world=world: renderer(world),
            "smooth": lambda smooth=smooth, world=world: smooth(world),
            "peer": peer,
            "fill": lambda canvas=canvas: floor(scenes, canvas),
        }
        figure = least(runs, arguments.repeats, scenes)
        batch, (image, ids, _) = renderer(world), peer()
        differ = float((batch.instance.numpy() != ids).mean())
        figures = (*figure.values(), figure["peer"] / figure["ours"], figure["ours"] / figure["fill"], differ)
        print(f"{canvas[1]}x{canvas[0]}", *(f"{value:9.3f}" for value in figures), f" {peer.name}", flush=True)
        if arguments.pictures:
            import cv2

            both = np.concatenate([batch.image[0].permute(1, 2, 0).numpy(), image[0]])
            cv2.imwrite(f"{arguments.pictures}/{canvas[1]}.png", both[..., ::-1])


if __name__ == "__main__":
    main()
