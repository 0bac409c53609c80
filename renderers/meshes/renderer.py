"""Worlds of meshes to labelled images, on the CPU.

A pixel shows what its middle sees: the nearest triangle that faces the camera, the ground, or the sky. Light is added
and multiplied in sRGB and clipped once, at the end: a face's colour, times the tint if it takes one, times the texture,
times the light of the sun, where a shadow map lets it through, and of the sky, of which an upright surface gets three
quarters and one that faces down half; then haze, and what the world's ``CameraEffects`` says. Corners' normals are
interpolated as they are, not to unit length. Textures are filtered bilinearly, from a level chosen for their width and
height apart. The ground's textures lie from x = ``offset`` and y = 0; it is seen from above only. Nothing nearer than
0.1 m along the camera's z is seen. A sun below the horizon gives no light.

Shadows fall within 60 m of the camera, or 36 times its height; texels of the map are about a decimetre wide there, less
where few things cast shadows.

With four samples a pixel its colour is the mean of what they see; labels and depth are those of its middle, the same
bytes as with one.
"""

from typing import Any

import numpy as np
import torch

from probscene.batch import RenderBatch, SceneGeometry
from probscene.errors import ModelError
from probscene.request import Renderable
from probscene.world import World

from .. import engine
from ..camera.effects import EffectsProcessor, effects_table, seeds_of
from ..kernels.lanes import LANES
from .instances import Instances, instances, names
from .kernels import draw as kernel
from .kernels import shading as shading_kernel
from .kernels.shadows import SPARE
from .kernels.vertices import CORNER
from .tables import layout
from .tables.atlas import MeshAtlas

_MAX_CANVAS = 1 << 24
_SCENES = 64  # of one launch
_CHUNK = 1 << 28  # pixels of one launch; the kernel's offsets are 32-bit
_MOST_TRIANGLES = 1 << 22


class MeshRenderer:
    """A ``Renderer`` of worlds: ``MeshRenderer((375, 1242))(world)``.

    The same world gives the same bytes for any number of threads and however it is split into batches. Besides what it
    returns, a call needs for each thread about 18 bytes a pixel, 50 with four samples, and 96 bytes a triangle of the
    fullest scene, which are kept for the next call, as are up to 224 MiB of meshes and textures.

    Args:
        canvas: height and width of the images, pixels.
        threads: how many threads render, by default one for every core that the process may use.
        samples: 4 for smooth edges, 1 without.

    Raises:
        ModelError: a canvas that is empty or of more than 2**24 pixels, fewer than one thread, other samples.
    """

    def __init__(self, canvas: tuple[int, int], threads: int | None = None, samples: int = 1):
        if samples not in (1, 4):
            raise ModelError(f"expected 1 or 4 samples a pixel, got {samples}.")
        self.canvas, self.threads = engine.check_canvas(canvas, threads, _MAX_CANVAS)
        self.samples, self.map_size = samples, min(2048, max(256, 5 * self.canvas[1] // 96 * 16))
        self._atlas, self._finish = MeshAtlas(), EffectsProcessor(self.canvas, self.threads)
        self._scratch: dict[str, np.ndarray] = {}

    def __call__(self, drawing: Renderable) -> RenderBatch:
        """Render every scene of a world.

        Where several labelled layers draw a node, its labels are those of all of them together; its 3D box is turned
        as the first layer's mesh is and holds the boxes of the others.

        Raises:
            ModelError: it is a drawing in 2D; the world holds what cannot be rendered, see ``instances``, or more than
                2**22 triangles in sight of one scene.
            ProbsceneError: in a process forked from one in which the engine ran.
        """
        if not isinstance(drawing, World):
            raise ModelError(f"expected a World of meshes, got a {type(drawing).__name__}; take SpriteRenderer.")
        world = drawing
        engine.start()
        self._atlas.trim()
        (N, M), (height, width) = world.kind.shape, self.canvas
        pixels = height * width
        room, types = N * pixels + LANES, ((np.uint8, 3), (np.int16, 1), (np.uint8, 1), (np.float32, 1))
        image, instance, semantic, depth = (np.empty(each * room, dtype) for dtype, each in types)
        nodes = max(1, N), max(1, M)
        result = np.tile(np.array([width, height, 0, 0, 0, 0], np.int32), (*nodes, 1))
        extent = np.tile(np.array([np.inf, np.inf, -np.inf, -np.inf]), (*nodes, 1))
        drawn, box = np.zeros((N, M), bool), np.zeros((N, M, 7))
        step = min(_SCENES, max(1, _CHUNK // pixels // 8 * 8))  # images begin at whole words
        for start in range(0, N, step):
            part = slice(start, min(start + step, N))
            table = instances(world[part], self._atlas, self.canvas, self.map_size)
            here = slice(start * pixels, part.stop * pixels + LANES)
            self._render(
                world[part], table, image[3 * here.start : 3 * here.stop], instance[here], semantic[here],
                depth[here], result[part].reshape(-1), extent[part].reshape(-1),
            )  # fmt: skip
            drawn[part], box[part] = table.drawn, table.box
        return RenderBatch(
            image=torch.from_numpy(image[: 3 * N * pixels].reshape(N, height, width, 3)).permute(0, 3, 1, 2),
            instance=torch.from_numpy(instance[: N * pixels].reshape(N, height, width)),
            kind=torch.where(torch.from_numpy(drawn), world.kind.cpu(), -1),
            **_labels(result[:N, :M], extent[:N, :M], self.canvas),
            space=SceneGeometry(
                depth=torch.from_numpy(depth[: N * pixels].reshape(N, height, width)),
                semantic=torch.from_numpy(semantic[: N * pixels].reshape(N, height, width)),
                names=names(world),
                truncated=_truncated(extent[:N, :M], self.canvas),
                box=torch.from_numpy(box.astype(np.float32)),
                intrinsics=_intrinsics(world),
            ),
        )

    def _render(self, world: World, table: Instances, image, instance, semantic, depth, result, extent) -> None:
        (height, width), N = self.canvas, len(world)
        most_vertices, triangles = table.most
        if triangles > _MOST_TRIANGLES:
            raise ModelError(
                f"expected at most {_MOST_TRIANGLES} triangles in sight of a scene, got {triangles}; "
                "use coarser meshes or fewer."
            )
        strips = 0 if world.ground is None else world.ground.surface.shape[1]
        room = (height * width + 3 * LANES - 1) // LANES * LANES
        most_records, seen = triangles + strips + 1, room * (1 if self.samples == 1 else 5)
        shadow = self.map_size**2 + SPARE
        each = {
            "seen": (seen, np.uint64),
            "stamp": (height * ((width + 63) // 64), np.uint64),
            "shadow": (shadow, np.float32),
            "opened": (shadow // SPARE, np.int32),  # a tile each
            "corners": (most_vertices * CORNER, np.float64),
            "records": (most_records * shading_kernel.RECORD, np.float32),
            "marks": (most_records * shading_kernel.MARKS, np.int32),
            "line": (3 * width, np.float32),
            "bounds": (2 * max(1, strips), np.int32),
        }
        largest = max(size for size, _ in each.values())
        workers = max(1, min(self.threads, N, ((1 << 31) - 1) // largest))
        for name, (size, dtype) in each.items():
            if name not in self._scratch or self._scratch[name].size < workers * size:
                self._scratch[name] = _zeros(max(1, workers * size), dtype)
        self._scratch["opened"][:] = 0
        atlas, photos = self._atlas, effects_table(world.photo, N, self.canvas, exposed=True).ravel()
        buffers = [self._scratch[name] for name in each]
        buffers += [image, instance, semantic, depth, self._scratch["seen"].reshape(-1, LANES)]
        buffers += [_words(flat) for flat in (self._scratch["shadow"], image, instance, semantic, depth)]
        buffers += [result, extent]
        kernel.render(
            self.samples == 4, workers, N, height, width, max(1, world.kind.shape[1]), strips, self.map_size,
            most_vertices, most_records, np.zeros(1, np.int32), table.first, table.whole, table.real, table.scenes,
            photos, seeds_of(world.photo), table.edges, table.strips, table.tiles,
            atlas.positions, atlas.corners, atlas.faces, atlas.textures.table, atlas.textures.texels,
            *buffers,
        )  # fmt: skip
        self._finish(world.photo, image, N, toned=True)


def _zeros(size: int, dtype: type) -> np.ndarray:
    """Zeros; those of more than 2 MiB lie in as few pages as can be, which NumPy asks for from 4 MiB on."""
    nbytes = size * np.dtype(dtype).itemsize
    return np.zeros(max(nbytes, 1 << 22) if nbytes > 1 << 21 else nbytes, np.uint8)[:nbytes].view(dtype)


def _words(flat: np.ndarray) -> np.ndarray:
    """A view of as much of a flat array as is whole words of 64 bits."""
    return flat[: flat.nbytes // 8 * 8 // flat.itemsize].view(np.uint64)


def _labels(result: np.ndarray, extent: np.ndarray, canvas: tuple[int, int]) -> dict[str, Any]:
    seen, whole = result[..., layout.PIXELS], result[..., layout.WHOLE]
    box = np.where(seen[..., None] > 0, result[..., layout.BOX : layout.BOX + 4], 0)
    amodal = np.where(extent[..., :1] <= extent[..., 2:3], extent, 0)
    return {
        "box": torch.from_numpy(box.astype(np.float32)),
        "amodal_box": torch.from_numpy(amodal.astype(np.float32)),
        "pixels": torch.from_numpy(seen.astype(np.int64)),
        "visible": torch.from_numpy((seen / np.maximum(whole, 1)).astype(np.float32)),
    }


def _truncated(extent: np.ndarray, canvas: tuple[int, int]) -> torch.Tensor:
    """Share of the extent outside the canvas; all of one without area is where its middle is."""
    height, width = canvas
    silhouette = extent[..., 0] <= extent[..., 2]
    extent = np.where(silhouette[..., None], extent, 0)
    low, high = extent[..., :2], extent[..., 2:]
    inside = np.clip(np.minimum(high, [width, height]) - np.maximum(low, 0), 0, None)
    whole = high - low
    share = np.where(whole > 0, inside / np.where(whole > 0, whole, 1), (low >= 0) & (low <= [width, height]))
    return torch.from_numpy(np.where(silhouette, 1 - share[..., 0] * share[..., 1], 0).astype(np.float32))


def _intrinsics(world: World) -> torch.Tensor:
    camera, matrix = world.camera, torch.zeros(len(world), 3, 3)
    matrix[:, 0, 0] = matrix[:, 1, 1] = camera.focal
    matrix[:, 0, 2], matrix[:, 1, 2], matrix[:, 2, 2] = camera.centre_x, camera.centre_y, 1
    return matrix
