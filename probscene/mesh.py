"""Triangle meshes and the surfaces of a ground: what 3D scenes are made of.

A mesh stands as it is used: metres, +x forward, +y left, +z up, its lowest point at z = 0, centred in x and y. Axis
letters: V vertices, F triangles, h w texels.
"""

from dataclasses import dataclass

import numpy as np

from .errors import ModelError

MAX_MESH_SIZE = 200.0  # metres; what is larger was not made in metres


@dataclass(frozen=True, eq=False)
class Mesh:
    """An immutable triangle mesh, lit on its outside only.

    Args:
        positions: ``(V, 3)`` float32, metres.
        triangles: ``(F, 3)`` int32 vertices, anticlockwise as seen from outside.
        colour: ``(F, 3)`` uint8 sRGB, or ``(3,)`` for all.
        tinted: ``(F,)`` bool, which triangles take the tint of an instance, a car's paint and not its tyres; all if
            None.
        normals: ``(F, 3, 3)`` float32 unit normals of each triangle's corners; the triangle's own if None, which gives
            facets.
        uv: ``(F, 3, 2)`` float32 texture coordinates of the corners, repeating beyond 0..1, v downward.
        texture: ``(h, w, 3)`` uint8 sRGB, multiplies the colour; needs ``uv``.

    Raises:
        ModelError: no triangle, an array of another shape, a vertex that is not there, values that are not finite, a
            colour of 0 to 1 or beyond 255, or a mesh of more than 200 m.
    """

    positions: np.ndarray
    triangles: np.ndarray
    colour: np.ndarray
    tinted: np.ndarray | None = None
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None
    texture: np.ndarray | None = None

    def __post_init__(self):
        F = len(self.triangles)
        if F == 0 or len(self.positions) == 0:
            raise ModelError("expected a mesh with triangles, got an empty one; export it again.")
        colour = np.asarray(self.colour)
        tinted = np.ones(F, bool) if self.tinted is None else self.tinted
        self._keep("positions", self.positions, np.float32, (len(self.positions), 3))
        self._keep("triangles", self.triangles, np.int32, (F, 3))
        self._keep("colour", np.broadcast_to(colour, (F, 3)) if colour.ndim == 1 else colour, np.uint8, (F, 3))
        self._keep("tinted", tinted, bool, (F,))
        if self.normals is not None:
            self._keep("normals", self.normals, np.float32, (F, 3, 3))
        if self.texture is not None:
            if self.uv is None:
                raise ModelError("expected texture coordinates (uv) with the texture of a mesh, got none.")
            self._keep("texture", self.texture, np.uint8, (*np.shape(self.texture)[:2], 3))
        if self.uv is not None:
            self._keep("uv", self.uv, np.float32, (F, 3, 2))
        low, high = int(self.triangles.min()), int(self.triangles.max())
        if low < 0 or high >= len(self.positions):
            raise ModelError(
                f"expected vertices 0..{len(self.positions) - 1} in a mesh's triangles, got {low}..{high}."
            )
        size = float(np.ptp(self.positions, axis=0).max())
        if not 0 < size <= MAX_MESH_SIZE:
            raise ModelError(
                f"expected a mesh of at most {MAX_MESH_SIZE:g} m, got {size:g} m; meshes are in metres, scale it."
            )

    def _keep(self, name: str, value: np.ndarray, dtype: type, shape: tuple[int, ...]) -> None:
        value = np.asarray(value)
        if value.shape != shape or value.size == 0:
            raise ModelError(f"expected {name} of a mesh of shape {shape}, got {value.shape}.")
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise ModelError(f"expected finite {name} of a mesh, got NaN or infinity; export it again.")
        if dtype is np.uint8:
            low, high = float(value.min()), float(value.max())
            if low < 0 or high > 255:
                raise ModelError(
                    f"expected {name} of a mesh in 0..255, got {low if low < 0 else high:g}; clip it there."
                )
            if value.dtype.kind == "f" and 0 < high <= 1:
                raise ModelError(f"expected {name} of a mesh in 0..255, got {high:g}; multiply by 255.")
        value = np.ascontiguousarray(value, dtype).copy()
        value.flags.writeable = False
        object.__setattr__(self, name, value)

    @property
    def size(self) -> np.ndarray:
        """Length, width and height, ``(3,)`` metres along x, y and z."""
        return np.ptp(self.positions, axis=0)


@dataclass(frozen=True, eq=False)
class Surface:
    """What a strip of ground is covered with: a texture that repeats.

    Args:
        name: its semantic class, such as ``"road"``; several surfaces may share one.
        texture: ``(h, w, 3)`` uint8 sRGB; rows run along +x, away from the texture's first row, columns along -y.
        tile: length in x and in y that the texture covers, metres.

    Raises:
        ModelError: a texture of another shape, or a tile without extent.
    """

    name: str
    texture: np.ndarray
    tile: tuple[float, float]

    def __post_init__(self):
        texture = np.ascontiguousarray(self.texture).copy()
        if texture.ndim != 3 or texture.shape[2] != 3 or texture.dtype != np.uint8 or texture.size == 0:
            raise ModelError(f"expected the texture of {self.name!r} as uint8 (h, w, 3), got {texture.shape}.")
        if min(self.tile) <= 0:
            raise ModelError(f"expected a tile of {self.name!r} with extent in metres, got {self.tile}.")
        texture.flags.writeable = False
        object.__setattr__(self, "texture", texture)
