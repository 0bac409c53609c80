"""3D scenes: what a scene model builds and the mesh renderer reads.

The world is in metres, x forward along the road, y to the left, z up, the ground at z = 0. The camera's own axes are
KITTI's: x to the right, y down, z forward. Its intrinsics are in the convention of KITTI and OpenCV, in which the
middle of the upper left pixel is (0, 0); boxes are in pixels from the outer edge of that pixel, so that a point that
projects to u lies at u + 0.5 in a box. Colours are sRGB in 0..1. Axis letters: N scenes, M nodes, S strips of ground.
"""

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from torch import Tensor

from .camera_effects import CameraEffects, check_camera_effects
from .drawing import check_colour, select_scenes
from .errors import ModelError
from .mesh import Mesh, Surface

KITTI_FOCAL, KITTI_CENTRE, KITTI_CANVAS, KITTI_HEIGHT = 721.5377, (609.5593, 172.854), (375, 1242), 1.65


@dataclass(frozen=True, eq=False)
class Meshes:
    """One mesh for every node of the named kinds, or decoration that belongs to no node.

    All tensors broadcast to ``(N, M)``; entries at nodes of other kinds are ignored.

    Args:
        kinds: the kinds of node that this layer draws, a name or several; ``()`` for decoration, which has no label.
            Then M is the last axis of ``present``, how much there may be of it in a scene.
        meshes: what ``mesh`` chooses from.
        mesh: index into them.
        x, y, z: where the mesh's origin is, metres.
        yaw: radians, anticlockwise as seen from above.
        scale: of the mesh, one number or ``(..., 3)`` along its own x, y and z.
        tint: sRGB in 0..1 that multiplies the colour of the tinted triangles, ``(3,)`` or ``(N, M, 3)``.
        labelled: whether nodes get an instance id; False for layers that only cover others.
        present: ``(N, M)`` bool, which of them are drawn; all if None.
    """

    kinds: str | tuple[str, ...]
    meshes: tuple[Mesh, ...]
    mesh: Tensor | int
    x: Tensor | float
    y: Tensor | float
    z: Tensor | float = 0.0
    yaw: Tensor | float = 0.0
    scale: Tensor | float = 1.0
    tint: Tensor | tuple[float, float, float] = (1.0, 1.0, 1.0)
    labelled: bool = True
    present: Tensor | None = None


@dataclass(frozen=True, eq=False)
class MeshLayer:
    """``Meshes`` resolved on a batch of scenes: every tensor has its full shape.

    ``present (N, M)`` bool; ``mesh (N, M)`` int64; ``x, y, z, yaw (N, M)`` float32; ``scale, tint (N, M, 3)`` float32.
    """

    meshes: tuple[Mesh, ...]
    present: Tensor
    mesh: Tensor
    x: Tensor
    y: Tensor
    z: Tensor
    yaw: Tensor
    scale: Tensor
    tint: Tensor
    labelled: bool


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole cameras, one a scene; all are numbers or broadcast to ``(N, 1)``.

    Args:
        focal: focal length, pixels.
        centre_x, centre_y: principal point, pixels.
        x, y, z: where it stands, metres.
        yaw, pitch, roll: radians: to the left, down, and clockwise as the camera sees.
    """

    focal: Tensor | float = KITTI_FOCAL
    centre_x: Tensor | float = KITTI_CENTRE[0]
    centre_y: Tensor | float = KITTI_CENTRE[1]
    x: Tensor | float = 0.0
    y: Tensor | float = 0.0
    z: Tensor | float = KITTI_HEIGHT
    yaw: Tensor | float = 0.0
    pitch: Tensor | float = 0.0
    roll: Tensor | float = 0.0

    @staticmethod
    def kitti(canvas: tuple[int, int], **pose) -> "Camera":
        """KITTI's left colour camera, whose 1242 x 375 pixels are resized to the canvas's width.

        Args:
            canvas: height and width, pixels.
            pose: as of a ``Camera``.
        """
        by = canvas[1] / KITTI_CANVAS[1]
        middle = (KITTI_CENTRE[1] + 0.5) * canvas[0] / KITTI_CANVAS[0] - 0.5
        return Camera(KITTI_FOCAL * by, (KITTI_CENTRE[0] + 0.5) * by - 0.5, middle, **pose)


@dataclass(frozen=True, eq=False)
class Light:
    """Sun, sky and air; all are numbers or broadcast to ``(N, 1)``, colours ``(3,)`` or ``(N, 3)``.

    Args:
        azimuth, elevation: of the sun, radians: from +x to the left, and above the horizon.
        sun: its strength, 0 under clouds; a surface that faces it and the sky gets ``sun + ambient``.
        ambient: strength of the light of the sky.
        zenith, horizon: colours of the sky, blended by the sine of the elevation.
        haze: share of the horizon's colour that a metre of air adds, ``1 - exp(-haze * distance)``.
    """

    azimuth: Tensor | float = 0.8
    elevation: Tensor | float = 0.9
    sun: Tensor | float = 0.7
    ambient: Tensor | float = 0.45
    zenith: Tensor | tuple[float, float, float] = (0.35, 0.55, 0.85)
    horizon: Tensor | tuple[float, float, float] = (0.80, 0.86, 0.92)
    haze: Tensor | float = 0.001


@dataclass(frozen=True, eq=False)
class Ground:
    """A plane at z = 0 in strips along x.

    Args:
        surfaces: what ``surface`` chooses from.
        edges: ``(N, S - 1)`` y of the borders between strips, metres, ascending from the right of the road to the left;
            strips without width are not seen.
        surface: ``(N, S)`` int64 index into ``surfaces``.
        offset: ``(N, 1)`` or a number, metres by which the textures are shifted along x.
    """

    surfaces: tuple[Surface, ...]
    edges: Tensor
    surface: Tensor
    offset: Tensor | float = 0.0


@dataclass(frozen=True, eq=False)
class World:
    """A batch of 3D scenes, ready to be rendered: ``SceneGraph.build`` makes it.

    Args:
        kind: ``(N, M)`` int64, index into ``kinds``; -1 pads.
        kinds: the grammar's object names.
        layers: what stands in it.
        camera, light, ground, photo: of each scene; every tensor is ``(N,)``, colours ``(N, 3)``, and of the ground as
            in ``Ground``. No ground where None.
    """

    kind: Tensor
    kinds: tuple[str, ...]
    layers: tuple[MeshLayer, ...]
    camera: Camera
    light: Light
    ground: Ground | None
    photo: CameraEffects

    def __len__(self) -> int:
        return self.kind.shape[0]

    def __getitem__(self, scenes: slice | Tensor) -> "World":
        """The same world of some of the scenes."""

        parts = {name: select_scenes(getattr(self, name), scenes) for name in ("camera", "light", "photo", "ground")}
        layers = tuple(select_scenes(layer, scenes) for layer in self.layers)
        return replace(self, kind=self.kind[scenes], layers=layers, **parts)


COLOURS = ("zenith", "horizon")


def resolve_meshes(layer: Meshes, present: Tensor) -> MeshLayer:
    """Broadcast a ``Meshes`` to ``present (N, M)`` and check what a renderer relies on.

    Raises:
        ModelError: a tensor that does not broadcast, an index outside the meshes, a value that is not finite, or a tint
            of another scale than 0..1.
    """
    name = f"Meshes({layer.kinds!r})"
    index = _full(f"{name}.mesh", layer.mesh, tuple(present.shape), torch.int64)
    chosen = index[present]
    if chosen.numel() and not (0 <= int(chosen.min()) and int(chosen.max()) < len(layer.meshes)):
        raise ModelError(
            f"expected {name}.mesh in 0..{len(layer.meshes) - 1}, got {int(chosen.min())}..{int(chosen.max())}."
        )
    numbers = {}
    for key in ("x", "y", "z", "yaw"):
        numbers[key] = _full(f"{name}.{key}", getattr(layer, key), tuple(present.shape), among=present)
    for key in ("scale", "tint"):
        value = torch.as_tensor(getattr(layer, key), dtype=torch.float32)
        if key == "scale" and (value.ndim < 1 or value.shape[-1] != 3 or value.ndim == 2):
            value = value.unsqueeze(-1)
        numbers[key] = _full(f"{name}.{key}", value, (*present.shape, 3), among=present)
    if not (numbers["scale"][present] > 0).all():
        raise ModelError(f"expected positive {name}.scale, got {float(numbers['scale'][present].min()):g}.")
    check_colour(f"{name}.tint", numbers["tint"][present])
    return MeshLayer(layer.meshes, present, index, labelled=layer.labelled, **numbers)


Photo = CameraEffects  # its name in models of 0.1, which runs keep
Part = TypeVar("Part", Camera, Light, CameraEffects)


def resolve_scene(part: Part, num_scenes: int) -> Part:
    """Every field as one value a scene, ``(N,)`` float32, colours ``(N, 3)``; seeds int64.

    Raises:
        ModelError: a value of another shape, one that is not finite, a colour of another scale than 0..1, a focal
            length that is not positive, or what a photo cannot have.
    """
    values = {}
    for field in fields(part):
        name, value = f"{type(part).__name__}.{field.name}", getattr(part, field.name)
        if field.name in COLOURS:
            values[field.name] = _full(name, value, (num_scenes, 3))
            check_colour(name, values[field.name])
        else:
            dtype = torch.int64 if field.name == "seed" else torch.float32
            endless = field.name == "jpeg_quality"
            values[field.name] = _full(name, value, (num_scenes, 1), dtype, endless=endless).squeeze(1)
    if isinstance(part, Camera) and not (values["focal"] > 0).all():
        worst = float(values["focal"].min())
        raise ModelError(f"expected a positive focal length in pixels, got {worst:g}; fix Camera.focal of the model.")
    if isinstance(part, CameraEffects):
        check_camera_effects(values)
    return replace(part, **values)


def resolve_ground(ground: Ground, num_scenes: int) -> Ground:
    """Strips of every scene, ``edges (N, S - 1)``, ``surface (N, S)``, ``offset (N,)``.

    Raises:
        ModelError: strips and edges that do not fit, edges out of order, or an index outside the surfaces.
    """
    strips = torch.as_tensor(ground.surface).shape[-1]
    surface = _full("Ground.surface", ground.surface, (num_scenes, strips), torch.int64)
    edges = _full("Ground.edges", ground.edges, (num_scenes, strips - 1))
    if strips > 1 and not (edges.diff(dim=1) >= 0).all():
        raise ModelError("expected Ground.edges in ascending order, got some that are not; sort them.")
    if surface.numel() and not (0 <= int(surface.min()) and int(surface.max()) < len(ground.surfaces)):
        raise ModelError(
            f"expected Ground.surface in 0..{len(ground.surfaces) - 1}, got {int(surface.min())}..{int(surface.max())}."
        )
    offset = _full("Ground.offset", ground.offset, (num_scenes, 1)).squeeze(1)
    return replace(ground, edges=edges, surface=surface, offset=offset)


def _full(
    name: str, value, shape: tuple[int, ...], dtype=torch.float32, among: Tensor | None = None, endless: bool = False
) -> Tensor:
    value = torch.as_tensor(value, dtype=dtype).detach()
    try:
        value = value.expand(shape)
    except RuntimeError:
        raise ModelError(f"expected {name} to broadcast to {shape}, got shape {tuple(value.shape)}.") from None
    checked = value if among is None else value[among]
    if value.is_floating_point() and not endless and not torch.isfinite(checked).all():
        raise ModelError(f"expected finite values in {name}, got NaN or infinity.")
    return value.contiguous()
