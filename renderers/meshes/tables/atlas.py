"""Meshes and surfaces as the kernels read them: flat arrays, made when first drawn and kept for the next call."""

from weakref import WeakKeyDictionary

import numpy as np

from probscene.errors import ModelError
from probscene.mesh import Mesh, Surface

from .texture_atlas import TextureAtlas

# Columns of a face: sRGB colour in 0..1, whether it takes a tint, whether its corners' normals differ, the normals and
# texture coordinates of its corners.
COLOUR, TINTED, SMOOTH, NORMAL, UV, FACE = 0, 3, 4, 5, 14, 20
# Columns of ``rows``, one row a mesh: where its vertices and triangles begin, how many there are, its texture, 0 for
# none, whether it is closed.
VERTEX, VERTICES, TRIANGLE, TRIANGLES, TEXTURE, CLOSED = range(6)

_FACES, _TEXELS = 1 << 20, 1 << 24  # kept between calls, 96 MiB and 128 MiB
_MOST = (1 << 31) // FACE  # the kernel's indices are 32-bit


class MeshAtlas:
    """Everything that was drawn lately; meshes and surfaces are known by their identity.

    Attributes:
        positions: float32, three a vertex.
        corners: int32, three a triangle, counted from the mesh's first vertex.
        faces: float32, ``FACE`` a triangle.
        textures: of meshes and surfaces.
    """

    def __init__(self):
        self._clear()

    def _clear(self) -> None:
        self._meshes: WeakKeyDictionary[Mesh, int] = WeakKeyDictionary()
        self._surfaces: WeakKeyDictionary[Surface, int] = WeakKeyDictionary()
        self._covers = 0  # surfaces that were ever added
        self._rows, self._bounds = np.zeros((0, 6), np.int64), np.zeros((0, 2, 3))
        self.positions, self.corners = np.zeros(3, np.float32), np.zeros(3, np.int32)  # the engine takes no empty array
        self.faces = np.zeros(FACE, np.float32)
        self.textures = TextureAtlas()

    def trim(self) -> None:
        """Forget everything once it has grown large or most of it is gone; to be called between worlds."""
        packed, living = len(self._rows) + self._covers, len(self._meshes) + len(self._surfaces)
        if self.corners.size > 3 * _FACES or self.textures.texels.size > _TEXELS or packed > 2 * living:
            self._clear()

    def add(self, meshes: list[Mesh], surfaces: list[Surface]) -> None:
        """Pack those that are not known yet.

        Raises:
            ModelError: more triangles or texels than 31 bits can count.
        """
        meshes = [mesh for mesh in dict.fromkeys(meshes) if mesh not in self._meshes]
        surfaces = [surface for surface in dict.fromkeys(surfaces) if surface not in self._surfaces]
        self._surfaces.update(zip(surfaces, self.textures.add([surface.texture for surface in surfaces]), strict=True))
        self._covers += len(surfaces)
        if not meshes:
            return
        textured = {mesh: mesh.texture for mesh in meshes if mesh.texture is not None}
        texture = dict(zip(textured, self.textures.add([*textured.values()]), strict=True))
        vertices = np.array([0, *(len(mesh.positions) for mesh in meshes)])
        triangles = np.array([0, *(len(mesh.triangles) for mesh in meshes)])
        if self.faces.size // FACE + triangles.sum() > _MOST:
            raise ModelError(f"expected at most {_MOST} triangles in the meshes of a world, got more; use fewer.")
        rows = np.stack(
            [
                len(self.positions) // 3 + vertices.cumsum()[:-1],
                vertices[1:],
                len(self.corners) // 3 + triangles.cumsum()[:-1],
                triangles[1:],
                [texture.get(mesh, 0) for mesh in meshes],
                [_closed(mesh) for mesh in meshes],
            ],
            1,
        )
        bounds = [[mesh.positions.min(0), mesh.positions.max(0)] for mesh in meshes]
        self._meshes.update(zip(meshes, range(len(self._rows), len(self._rows) + len(meshes)), strict=True))
        self._rows, self._bounds = np.concatenate([self._rows, rows]), np.concatenate([self._bounds, bounds])
        self.positions = np.concatenate([self.positions, *(mesh.positions.ravel() for mesh in meshes)])
        self.corners = np.concatenate([self.corners, *(mesh.triangles.ravel() for mesh in meshes)])
        self.faces = np.concatenate([self.faces, *(_faces(mesh).ravel() for mesh in meshes)])

    def rows(self, meshes: tuple[Mesh, ...]) -> tuple[np.ndarray, np.ndarray]:
        """The rows of known meshes ``(len(meshes), 6)`` int64, and their least and largest x, y, z ``(.., 2, 3)``."""
        index = [self._meshes[mesh] for mesh in meshes]
        return self._rows[index], self._bounds[index]

    def surface(self, surface: Surface) -> int:
        """The texture of a known surface."""
        return self._surfaces[surface]


def _faces(mesh: Mesh) -> np.ndarray:
    faces = np.zeros((len(mesh.triangles), FACE), np.float32)
    faces[:, COLOUR : COLOUR + 3] = mesh.colour / 255
    faces[:, TINTED] = mesh.tinted
    if mesh.normals is None:
        a, b, c = (mesh.positions[mesh.triangles[:, i]].astype(np.float64) for i in range(3))
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.where(length > 0, normal / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
        faces[:, NORMAL : NORMAL + 9] = np.tile(normal, 3)
    else:
        faces[:, SMOOTH] = (mesh.normals != mesh.normals[:, :1]).any((1, 2))
        faces[:, NORMAL : NORMAL + 9] = mesh.normals.reshape(-1, 9)
    if mesh.uv is not None:
        faces[:, UV : UV + 6] = mesh.uv.reshape(-1, 6)
    return faces


def _closed(mesh: Mesh) -> bool:
    """Whether each edge of a triangle is, the other way round, one of another's, by where its ends are."""
    _, vertex = np.unique(mesh.positions, axis=0, return_inverse=True)
    start = vertex[mesh.triangles].astype(np.int64)
    end = np.roll(start, -1, axis=1)
    size = len(mesh.positions)
    return np.array_equal(np.sort(start * size + end, axis=None), np.sort(end * size + start, axis=None))
