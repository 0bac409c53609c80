"""The mesh renderer's slow twin, in plain numpy and float64: what ``MeshRenderer`` must agree with.

Every ray is met with every triangle it might hit, one triangle at a time; nothing is clipped, rasterised or
interpolated over the image. Texture steps are differences between neighbouring rays, and shadows are rays to the sun,
so that they are sharp and reach everywhere. It checks nothing, and shares no line with the renderer. Axis letter: P
rays.
"""

import numpy as np
import torch

from probscene.batch import RenderBatch, SceneGeometry
from probscene.world import World

from .camera_effects import apply_camera_effects
from .rays import meet, sample
from .scenes import SceneReference


class MeshReference:
    """The same call as ``MeshRenderer``: ``MeshReference((375, 1242))(world)``; black without ``colours``."""

    def __init__(self, canvas: tuple[int, int], samples: int = 1, colours: bool = True):
        self.canvas, self.samples, self.colours = canvas, samples, colours

    def __call__(self, world: World) -> RenderBatch:
        """Render every scene of a world."""
        (N, M), (height, width) = world.kind.shape, self.canvas
        surfaces = [] if world.ground is None else [surface.name for surface in world.ground.surfaces]
        names = ("sky", *world.kinds, *sorted(set(surfaces), key=surfaces.index), "decoration")
        image, instance = np.zeros((N, height, width, 3), np.uint8), np.zeros((N, height, width), np.int16)
        depth, semantic = np.zeros((N, height, width), np.float32), np.zeros((N, height, width), np.uint8)
        kind, pixels = torch.full((N, M), -1), np.zeros((N, M), np.int64)
        box, amodal, visible, truncated = (np.zeros((N, M, size), np.float32) for size in (4, 4, 1, 1))
        space_box, lens = np.zeros((N, M, 7), np.float32), np.zeros((N, 3, 3), np.float32)
        for n in range(N):
            scene = _Scene(world[n : n + 1], names)
            v, u = (axis.ravel().astype(float) for axis in np.mgrid[:height, :width])
            hits, silhouettes = scene.look(u, v)
            lens[n] = scene.lens
            instance[n] = np.array([0, 0, *(t.label for t in scene.triangles)])[hits.which + 2].reshape(height, width)
            semantic[n] = scene.kinds(hits, u, v).reshape(height, width)
            depth[n] = hits.depth.reshape(height, width)
            if self.colours:
                image[n] = self._image(scene, u, v)
            for m in range(M):
                if m not in scene.boxes:
                    continue
                kind[n, m], space_box[n, m] = world.kind[n, m], scene.boxes[m]
                mask, whole = instance[n] == m + 1, silhouettes[m].sum()
                pixels[n, m] = mask.sum()
                visible[n, m] = mask.sum() / max(1, whole)
                if mask.any():
                    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
                    box[n, m] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
                points = scene.outline(m)
                if len(points):
                    low, high = points.min(0), points.max(0)
                    amodal[n, m] = *low, *high
                    inside = np.clip(np.minimum(high, [width, height]) - np.maximum(low, 0), 0, None)
                    truncated[n, m] = 1 - np.prod(inside / np.maximum(high - low, 1e-12))
        visible, truncated = torch.from_numpy(visible[..., 0]), torch.from_numpy(truncated[..., 0])
        labels = [torch.from_numpy(x) for x in (depth, semantic, space_box, lens, box, amodal, pixels, instance, image)]
        depth, semantic, space_box, lens, box, amodal, pixels, instance, image = labels
        space = SceneGeometry(depth, semantic, names, truncated, space_box, lens)
        return RenderBatch(image.permute(0, 3, 1, 2), instance, kind, box, amodal, pixels, visible, space)

    def _image(self, scene: "_Scene", u, v) -> np.ndarray:
        shifts = [(0.0, 0.0)] if self.samples == 1 else [(a, b) for a in (-0.25, 0.25) for b in (-0.25, 0.25)]
        colours = np.mean([scene.colours(u + a, v + b) for a, b in shifts], 0).reshape(*self.canvas, 3)
        return apply_camera_effects(colours, scene.world.photo, 0).image


class _Scene(SceneReference):
    """The colours of a world of one scene."""

    def colours(self, u, v) -> np.ndarray:
        """``(P, 3)`` sRGB, before the camera's electronics."""
        light, (hits, _), ray = self.light, self.look(u, v), self.rays(u, v)
        length = np.linalg.norm(ray, axis=1)
        sine = np.clip(ray[:, 2] / length, 0, None)[:, None]
        colour = light["horizon"] + (light["zenith"] - light["horizon"]) * sine
        for i in np.unique(hits.which[hits.which > -2]):
            seen = hits.which == i
            here, depth = (u[seen], v[seen]), hits.depth[seen, None]
            points = self.eye + ray[seen] * depth
            if i >= 0:
                triangle = self.triangles[i]
                _, shares = meet(self.eye, ray[seen], triangle.corners)
                normal, surface = shares @ triangle.normals, triangle.colour * np.ones((seen.sum(), 1))
                if triangle.texture is not None:
                    surface = surface * sample(triangle.texture, *self._steps(here, self._uv, triangle))
            else:
                normal, surface = np.tile([0.0, 0.0, 1.0], (seen.sum(), 1)), self._ground_colours(here, points)
            cosine = np.where(self.sun[2] > 0, np.clip(normal @ self.sun, 0, None), 0) * (1 - self._shadow(points))
            strength = light["sun"] * cosine + light["ambient"] * (0.75 + 0.25 * normal[:, 2])
            clear = np.exp(-light["haze"] * depth * length[seen, None])
            colour[seen] = light["horizon"] + (surface * strength[:, None] - light["horizon"]) * clear
        return colour

    def _ground_colours(self, here, points) -> np.ndarray:
        ground, colours = self.world.ground, np.zeros((len(points), 3))
        chosen = ground.surface[0].numpy()[self._strips(points)]
        for index in np.unique(chosen):
            mine, surface = chosen == index, ground.surfaces[index]
            some = tuple(x[mine] for x in here)
            colours[mine] = sample(surface.texture, *self._steps(some, self._ground_uv, surface))
        return colours

    def _uv(self, u, v, triangle) -> np.ndarray:
        return meet(self.eye, self.rays(u, v), triangle.corners)[1] @ triangle.uv

    def _ground_uv(self, u, v, surface) -> np.ndarray:
        ray, offset = self.rays(u, v), float(self.world.ground.offset[0])
        points = self.eye - ray * (self.eye[2] / ray[:, 2:])
        return np.stack([-points[:, 1] / surface.tile[1], (points[:, 0] - offset) / surface.tile[0]], 1)

    def _steps(self, here, uv, what) -> tuple[np.ndarray, np.ndarray]:
        """Texture coordinates and how far they go in a pixel, each along the axis of the image where it is further."""
        (u, v), small = here, 1e-5
        across = uv(u + small, v, what) - uv(u - small, v, what)
        down = uv(u, v + small, what) - uv(u, v - small, what)
        return uv(u, v, what), np.maximum(np.abs(across), np.abs(down)) / (2 * small)

    def _shadow(self, points) -> np.ndarray:
        dark = np.zeros(len(points), bool)
        for triangle in self.triangles if self.light["sun"] > 0 else []:
            t, shares = meet(points, np.broadcast_to(self.sun, points.shape), triangle.corners)
            dark |= (t > 1e-3) & (shares >= 0).all(1)
        return dark
