"""The mesh renderer's slow twin, in plain numpy and float64: what ``MeshRenderer`` must agree with.

Every ray is met with every triangle, one triangle at a time; nothing is clipped, rasterised or interpolated over the
image. Texture steps are differences between neighbouring rays, and shadows are rays to the sun, so that they are sharp
and reach everywhere. It checks nothing, and shares no line with the renderer. Axis letter: P rays.
"""

from typing import NamedTuple

import numpy as np
import torch

from probscene.batch import RenderBatch, Space
from probscene.renderers.ray_reference import meet, noise, sample, turn
from probscene.world import MeshLayer, World

NEAR = 0.1


class Triangle(NamedTuple):
    """In the world: ``corners, normals (3, 3)``, ``uv (3, 2)``, ``colour (3,)``; who it belongs to and its texture."""

    corners: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    colour: np.ndarray
    texture: np.ndarray | None
    label: int
    kind: int


class Hits(NamedTuple):
    """What rays see: ``depth (P,)``, ``which (P,)`` triangle, -1 for the ground and -2 for the sky."""

    depth: np.ndarray
    which: np.ndarray


class MeshReference:
    """The same call as ``MeshRenderer``: ``MeshReference((375, 1242))(world)``."""

    def __init__(self, canvas: tuple[int, int], samples: int = 1):
        self.canvas, self.samples = canvas, samples

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
            shifts = [(0.0, 0.0)] if self.samples == 1 else [(a, b) for a in (-0.25, 0.25) for b in (-0.25, 0.25)]
            colour = np.mean([scene.colours(u + a, v + b) for a, b in shifts], 0)
            image[n] = scene.develop(colour).reshape(height, width, 3)
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
        space = Space(depth, semantic, names, truncated, space_box, lens)
        return RenderBatch(image.permute(0, 3, 1, 2), instance, kind, box, amodal, pixels, visible, space)


class _Scene:
    """A world of one scene, as triangles."""

    def __init__(self, world: World, names: tuple[str, ...]):
        self.world, self.names = world, names
        camera, light = (
            {k: x[0].numpy().astype(float) for k, x in vars(p).items()} for p in (world.camera, world.light)
        )
        self.light = light
        self.lens = np.array(
            [[camera["focal"], 0, camera["centre_x"]], [0, camera["focal"], camera["centre_y"]], [0, 0, 1]]
        )
        self.eye = np.array([camera["x"], camera["y"], camera["z"]])
        straight = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # the camera's x, y and z in the world, as columns
        self.axes = turn(2, camera["yaw"]) @ straight @ turn(0, -camera["pitch"]) @ turn(2, camera["roll"])
        azimuth, elevation = light["azimuth"], light["elevation"]
        flat = np.cos(elevation)
        self.sun = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        self.triangles: list[Triangle] = []
        self.boxes: dict[int, np.ndarray] = {}
        corners: dict[int, list[np.ndarray]] = {}
        for layer in world.layers:
            for m in layer.present[0].nonzero().flatten().tolist():
                self._stand(layer, m, corners)
        for m, points in corners.items():
            yaw = next(float(x.yaw[0, m]) for x in world.layers if x.labelled and x.present[0, m])
            self.boxes[m] = self._box(np.concatenate(points), yaw)

    def _stand(self, layer: MeshLayer, m: int, corners: dict[int, list[np.ndarray]]) -> None:
        mesh, scale = layer.meshes[int(layer.mesh[0, m])], layer.scale[0, m].numpy().astype(float)
        own = turn(2, float(layer.yaw[0, m]))
        at = np.array([float(layer.x[0, m]), float(layer.y[0, m]), float(layer.z[0, m])])
        points = mesh.positions.astype(float) * scale @ own.T + at
        tint = np.clip(layer.tint[0, m].numpy().astype(float), 0, 1)
        label, kind = (m + 1, 1 + int(self.world.kind[0, m])) if layer.labelled else (0, len(self.names) - 1)
        for i, triangle in enumerate(mesh.triangles):
            a, b, c = mesh.positions[triangle].astype(float)
            facet = np.tile(np.cross(b - a, c - a), (3, 1))
            normals = (facet if mesh.normals is None else mesh.normals[i].astype(float)) / scale
            normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12) @ own.T
            uv = np.zeros((3, 2)) if mesh.uv is None else mesh.uv[i].astype(float)
            colour = mesh.colour[i] / 255 * (tint if mesh.tinted[i] else 1)
            self.triangles.append(Triangle(points[triangle], normals, uv, colour, mesh.texture, label, kind))
        if layer.labelled:
            ends = np.stack([mesh.positions.min(0), mesh.positions.max(0)]).astype(float)
            eight = np.array([[ends[a, 0], ends[b, 1], ends[c, 2]] for a in (0, 1) for b in (0, 1) for c in (0, 1)])
            corners.setdefault(m, []).append(eight * scale @ own.T + at)

    def _box(self, points: np.ndarray, yaw: float) -> np.ndarray:
        own = points @ turn(2, yaw)
        low, high = own.min(0), own.max(0)
        bottom = np.array([*(low + high)[:2] / 2, low[2]]) @ turn(2, yaw).T
        heading = self.axes.T @ turn(2, yaw)[:, 0]
        length, width, height = high - low
        return np.array(
            [height, width, length, *self.axes.T @ (bottom - self.eye), np.arctan2(-heading[2], heading[0])]
        )

    def rays(self, u, v) -> np.ndarray:
        """Directions ``(P, 3)`` in the world that reach a depth of one metre."""
        return np.stack([u, v, np.ones_like(u)], 1) @ np.linalg.inv(self.lens).T @ self.axes.T

    def look(self, u, v) -> tuple[Hits, dict[int, np.ndarray]]:
        """The nearest of all that rays meet, and for each node which of them meet it at all."""
        ray = self.rays(u, v)
        depth, which = np.full(len(u), np.inf), np.full(len(u), -2)
        down = self._grounded(ray)
        depth[down], which[down] = -self.eye[2] / ray[down, 2], -1
        silhouettes = {m: np.zeros(len(u), bool) for m in self.boxes}
        for i, triangle in enumerate(self.triangles):
            if not self._faces(triangle):
                continue
            t, shares = meet(self.eye, ray, triangle.corners)
            hit = (shares >= 0).all(1) & (t >= NEAR)
            if triangle.label:
                silhouettes[triangle.label - 1] |= hit
            near = hit & (t <= depth)
            depth[near], which[near] = t[near], i
        return Hits(depth, which), silhouettes

    def _grounded(self, ray) -> np.ndarray:
        if self.world.ground is None or self.eye[2] <= 0:
            return np.zeros(len(ray), bool)
        return (ray[:, 2] < 0) & (-self.eye[2] <= NEAR * ray[:, 2])

    def _faces(self, triangle: Triangle) -> bool:
        a, b, c = triangle.corners
        return np.cross(b - a, c - a) @ (self.eye - a) > 0

    def _strips(self, points) -> np.ndarray:
        return (points[:, 1:2] >= self.world.ground.edges[0].numpy().astype(float)).sum(1)

    def kinds(self, hits: Hits, u, v) -> np.ndarray:
        """Classes ``(P,)``."""
        kinds = np.array([0, 0, *(triangle.kind for triangle in self.triangles)])[hits.which + 2]
        ground = hits.which == -1
        if ground.any():
            points = self.eye + self.rays(u, v)[ground] * hits.depth[ground, None]
            surface = self.world.ground.surface[0].numpy()[self._strips(points)]
            kinds[ground] = [self.names.index(self.world.ground.surfaces[i].name) for i in surface]
        return kinds

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

    def outline(self, m: int) -> np.ndarray:
        """Corners of what faces the camera and is beyond the near plane, in pixels of boxes."""
        points = []
        for triangle in self.triangles:
            if triangle.label == m + 1 and self._faces(triangle):
                corners = (triangle.corners - self.eye) @ self.axes
                for a, b in zip(corners, np.roll(corners, 1, axis=0), strict=True):
                    if a[2] >= NEAR:
                        points.append(a)
                    if (a[2] >= NEAR) != (b[2] >= NEAR):
                        points.append(a + (b - a) * (NEAR - a[2]) / (b[2] - a[2]))
        image = np.array(points).reshape(-1, 3) @ self.lens.T
        return image[:, :2] / image[:, 2:] + 0.5

    def develop(self, colour) -> np.ndarray:
        """Bytes of ``(P, 3)`` colours."""
        photo = {k: float(x[0]) for k, x in vars(self.world.photo).items() if k != "seed"}
        colour = colour * photo["exposure"]
        grey = (colour @ [0.299, 0.587, 0.114])[:, None]
        colour = grey + (colour - grey) * photo["saturation"]
        colour = 0.5 + (colour - 0.5) * photo["contrast"]
        colour = colour * 255 + photo["noise"] * noise(int(self.world.photo.seed[0]), len(colour))
        return np.clip(np.floor(colour + 0.5), 0, 255).astype(np.uint8)
