"""What rays meet in a world: the geometry of the mesh renderer's slow twin, in plain numpy and float64.

Rays are met with one triangle after another, each with those that pass within a pixel of its corners' box, or with all
where it reaches behind the camera. Axis letter: P rays.
"""

from typing import NamedTuple

import numpy as np

from probscene.world import MeshLayer, World

from .rays import meet, turn

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


class SceneReference:
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
        """The nearest of all that rays meet, row by row, and for each node which of them meet it at all."""
        ray = self.rays(u, v)
        depth, which = np.full(len(u), np.inf), np.full(len(u), -2)
        down = self._grounded(ray)
        depth[down], which[down] = -self.eye[2] / ray[down, 2], -1
        silhouettes = {m: np.zeros(len(u), bool) for m in self.boxes}
        for i, triangle in enumerate(self.triangles):
            if not self._faces(triangle):
                continue
            about = self._about(triangle, u, v)
            t, shares = meet(self.eye, ray[about], triangle.corners)
            hit = (shares >= 0).all(1) & (t >= NEAR)
            if triangle.label:
                silhouettes[triangle.label - 1][about] |= hit
            near = hit & (t <= depth[about])
            depth[about[near]], which[about[near]] = t[near], i
        return Hits(depth, which), silhouettes

    def _about(self, triangle: Triangle, u, v) -> np.ndarray:
        """Which rays might meet a triangle: all if it reaches behind the near plane."""
        corners = (triangle.corners - self.eye) @ self.axes
        if (corners[:, 2] < NEAR).any():
            return np.arange(len(u))
        image = corners @ self.lens.T
        image = image[:, :2] / image[:, 2:]
        (left, top), (right, bottom) = image.min(0) - 1, image.max(0) + 1
        first, last = np.searchsorted(v, top), np.searchsorted(v, bottom)
        return first + np.flatnonzero((u[first:last] > left) & (u[first:last] < right))

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
            first = 1 + len(self.world.kinds)  # a kind may have a surface's name
            kinds[ground] = [self.names.index(self.world.ground.surfaces[i].name, first) for i in surface]
        return kinds

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
