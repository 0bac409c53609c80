"""Drawing primitives: what a scene model builds and a renderer reads.

Coordinates are pixels with the origin in the upper left corner of the canvas, x to the right, y down; the centre of the
pixel in row i and column j is (j + 0.5, i + 0.5). Axis letters: N scenes, M nodes.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import cv2
import numpy as np
import torch
from torch import Tensor

from .camera_effects import CameraEffects
from .decoding import eight_bit, quiet, read, stored
from .errors import DataError, ModelError
from .image_bytes import Fault

_COLOUR_LIMITS = -1.0, 2.0  # within which a channel is clipped to 0..1; beyond them it has another scale


@dataclass(frozen=True, eq=False)
class Atlas:
    """An immutable set of sprites.

    Args:
        sprites: uint8 arrays ``(h, w, 4)``, RGBA with straight alpha; sizes may differ.

    Raises:
        ModelError: an array instead of a tuple of them, no sprite, or one of another shape or type.
    """

    sprites: tuple[np.ndarray, ...]

    def __post_init__(self):
        if not isinstance(self.sprites, list | tuple):
            raise ModelError(
                f"expected an Atlas of a tuple of arrays, got {_described(self.sprites)}; write Atlas((sprite,)) "
                "for one sprite, Atlas(tuple(sprites)) for several."
            )
        if not self.sprites:
            raise ModelError("expected at least one sprite in an Atlas, got none.")
        frozen = []
        for i, sprite in enumerate(self.sprites):
            if not isinstance(sprite, np.ndarray):
                raise ModelError(
                    f"expected sprite {i} as a numpy array, uint8 (h, w, 4) RGBA, got {_described(sprite)}; "
                    "np.asarray(image.convert('RGBA')) makes one of a picture."
                )
            if sprite.ndim != 3 or sprite.shape[2] != 4 or sprite.dtype != np.uint8 or sprite.size == 0:
                raise ModelError(
                    f"expected sprite {i} as uint8 (h, w, 4) RGBA, got {sprite.dtype} {sprite.shape}; "
                    "add an alpha channel and convert it to uint8."
                )
            copy = np.ascontiguousarray(sprite).copy()
            copy.flags.writeable = False
            frozen.append(copy)
        object.__setattr__(self, "sprites", tuple(frozen))

    def __len__(self) -> int:
        return len(self.sprites)

    @staticmethod
    def from_folder(path: Path | str) -> "Atlas":
        """The PNG files of a folder, sorted by name, each a sprite; hidden files are not read.

        Raises:
            DataError: no PNG there, or one that does not decode.
        """
        files = sorted(f for f in Path(path).glob("*") if f.suffix.lower() == ".png" and not f.name.startswith("."))
        if not files:
            raise DataError(f"expected PNG files in {path}, got none; put back what was taken out, or edit the model.")
        return Atlas(tuple(map(_picture, files)))

    @property
    def fingerprint(self) -> str:
        """Of its pixels: what a model says in ``assets``, so that its runs are bound to them."""
        digest = hashlib.sha256()
        for sprite in self.sprites:
            digest.update(repr(sprite.shape).encode() + sprite.tobytes())
        return digest.hexdigest()[:12]

    def pick(self, u: Tensor) -> Tensor:
        """The sprite that a value in [0, 1] chooses, each with the same share: int64 of the same shape."""
        return (u * len(self)).long().clamp(0, len(self) - 1)

    def feathered(self, widths: Sequence[float]) -> "Atlas":
        """Every sprite with its edge blurred by each of some widths: sprite i at ``len(widths) * i`` and after.

        A detector that sees one way of pasting alone learns to see the seam (Dwibedi, Misra, Hebert, *Cut, Paste and
        Learn*, ICCV 2017). Alpha is blurred and colour is not, so that a sprite should have colour beyond its edge.

        Args:
            widths: standard deviations, pixels of the sprite; 0 for as it is.
        """
        return Atlas(tuple(_feathered(sprite, width) for sprite in self.sprites for width in widths))


def _picture(file: Path) -> np.ndarray:
    """RGBA."""
    try:
        with quiet():
            found = eight_bit(stored(read(file), opacity=True)[0])
    except Fault as fault:
        raise DataError(f"expected a picture in {file}, got a file that {fault}; replace or delete it.") from fault
    if found.ndim == 2:
        found = np.repeat(found[..., None], 3, 2)
    return found if found.shape[2] == 4 else np.dstack([found, np.full(found.shape[:2], 255, np.uint8)])


def _feathered(sprite: np.ndarray, width: float) -> np.ndarray:
    if not width:
        return sprite
    alpha = cv2.GaussianBlur(sprite[..., 3], (0, 0), width, borderType=cv2.BORDER_CONSTANT)
    return np.dstack([sprite[..., :3], alpha])


def _described(value: Any) -> str:
    """A value's type, and an array's shape, for messages."""
    shape = getattr(value, "shape", None)
    return type(value).__name__ if shape is None else f"{type(value).__name__} {value.dtype} {tuple(shape)}"


def disc(size: int = 64) -> np.ndarray:
    """A white anti-aliased disc that touches its border, ``(size, size, 4)`` uint8."""
    axis = np.arange(size) + 0.5 - size / 2
    distance = np.hypot(axis[:, None], axis[None, :])
    sprite = np.full((size, size, 4), 255, np.uint8)
    sprite[..., 3] = np.rint(255 * np.clip(size / 2 - distance, 0, 1))
    return sprite


def box(size: int = 8) -> np.ndarray:
    """A white opaque square, ``(size, size, 4)`` uint8."""
    return np.full((size, size, 4), 255, np.uint8)


_DISC, _BOX = Atlas((disc(),)), Atlas((box(),))


@dataclass(frozen=True, eq=False)
class Sprites:
    """One sprite for every node of the named kinds, or decoration that belongs to no node.

    All tensors broadcast to ``(N, M)``; entries at nodes of other kinds are ignored.

    Args:
        kinds: the kinds of node that this layer draws, a name or several; ``()`` for decoration, which has no label.
            Then M is the last axis of ``present``, how much there may be of it in a scene.
        atlas: where the sprites are.
        sprite: index into the atlas.
        x, y: centre of the sprite, pixels.
        angle: radians, anticlockwise as seen on the screen.
        scale: canvas pixels per sprite pixel; ``scale_y`` differs from it where given.
        tint: RGB in 0..1 that multiplies the sprite's colour, ``(3,)`` or ``(N, M, 3)``.
        labelled: whether nodes get an instance id; False for layers that only cover others, such as shadows.
        present: ``(N, M)`` bool, which of them are drawn; all if None.
        keypoints: points of the sprite by name, for labels: ``{"nose": (u, v)}``, as shares of the sprite's width from
            its left edge and of its height from its upper edge. They are moved, turned and scaled as the sprite is.

    Raises:
        ModelError: an atlas that is none; keypoints of sprites without a label, or that are no pairs by name.
    """

    kinds: str | tuple[str, ...]
    atlas: Atlas
    sprite: Tensor | int
    x: Tensor | float
    y: Tensor | float
    angle: Tensor | float = 0.0
    scale: Tensor | float = 1.0
    scale_y: Tensor | float | None = None
    tint: Tensor | tuple[float, float, float] = (1.0, 1.0, 1.0)
    labelled: bool = True
    present: Tensor | None = None
    keypoints: Mapping[str, tuple[Tensor | float, Tensor | float]] | None = None

    def __post_init__(self):
        if not isinstance(self.atlas, Atlas):
            raise ModelError(
                f"expected an Atlas in Sprites({self.kinds!r}), got {_described(self.atlas)}; write "
                "Atlas((sprite,)) around a sprite, or Atlas(tuple(sprites)) around several."
            )
        if self.keypoints and (not self.labelled or self.kinds == ()):
            raise ModelError(
                f"expected keypoints of sprites with a label, got some of Sprites({self.kinds!r}) without one; give "
                "them to the layer that draws the object."
            )
        points = {} if self.keypoints is None else self.keypoints
        if not isinstance(points, Mapping) or not all(
            isinstance(name, str) and isinstance(point, tuple | list) and len(point) == 2
            for name, point in points.items()
        ):
            raise ModelError(
                f"expected the keypoints of Sprites({self.kinds!r}) as pairs by name, got {self.keypoints!r}; write "
                "keypoints={'nose': (0.5, 0.2)}, shares of the sprite's width and height."
            )

    @staticmethod
    def disc(kinds, x, y, radius, tint=(1.0, 1.0, 1.0), labelled: bool = True, keypoints=None) -> "Sprites":
        """Discs of ``radius`` pixels."""
        scale = radius * 2 / 64
        return Sprites(kinds, _DISC, 0, x, y, scale=scale, tint=tint, labelled=labelled, keypoints=keypoints)

    @staticmethod
    def box(  # noqa: PLR0913 - one for each property of a rectangle
        kinds, x, y, width, height, angle=0.0, tint=(1.0, 1.0, 1.0), labelled: bool = True, keypoints=None
    ) -> "Sprites":
        """Rectangles of ``width`` by ``height`` pixels, turned by ``angle``."""
        return Sprites(kinds, _BOX, 0, x, y, angle, width / 8, height / 8, tint, labelled, keypoints=keypoints)


@dataclass(frozen=True, eq=False)
class Layer:
    """``Sprites`` resolved on a batch of scenes: every tensor has its full shape.

    M is the scene's nodes, or the layer's own number of sprites where it is not ``labelled``. ``present (N, M)`` bool;
    ``sprite (N, M)`` int64; ``x, y, angle, scale_x, scale_y (N, M)`` float32; ``tint (N, M, 3)``. Where the K
    ``keypoint_names`` lie on the canvas is ``keypoints (N, M, K, 2)`` float64, of nodes of ``kinds``.
    """

    atlas: Atlas
    present: Tensor
    sprite: Tensor
    x: Tensor
    y: Tensor
    angle: Tensor
    scale_x: Tensor
    scale_y: Tensor
    tint: Tensor
    labelled: bool
    kinds: tuple[str, ...] = ()
    keypoint_names: tuple[str, ...] = ()
    keypoints: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Drawing:
    """A batch of scenes, ready to be rendered: layers from the back to the front, nodes in order within a layer.

    Args:
        kind: ``(N, M)`` int64, index into ``kinds``; -1 pads.
        kinds: the grammar's object names.
        layers: what to draw, in painter's order.
        background: RGB in 0..1.
        photo: what a camera makes of it, every value ``(N,)`` as ``world.resolve_scene`` gives it; nothing where None.

    Raises:
        ModelError: a background that is not three finite numbers, or of another scale than 0..1.
    """

    kind: Tensor
    kinds: tuple[str, ...]
    layers: tuple[Layer, ...]
    background: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0))
    photo: CameraEffects | None = None

    def __post_init__(self):
        try:
            rgb = [float(value) for value in self.background]
        except (TypeError, ValueError):
            rgb = []
        if len(rgb) != 3 or not np.isfinite(rgb).all():
            raise ModelError(
                f"expected the background of a drawing as three numbers in 0..1, red, green and blue, got "
                f"{self.background!r}; write background=(0.2, 0.2, 0.2)."
            )
        check_colour("background", torch.tensor(rgb))

    def __len__(self) -> int:
        return self.kind.shape[0]

    def __getitem__(self, scenes: slice | Tensor) -> "Drawing":
        """The same drawing of some of the scenes."""
        layers = tuple(select_scenes(layer, scenes) for layer in self.layers)
        return replace(self, kind=self.kind[scenes], layers=layers, photo=select_scenes(self.photo, scenes))


def check_colour(name: str, colour: Tensor) -> None:
    """See that finite channels of colours have the scale 0..1. What a distribution draws a little beyond is clipped.

    Raises:
        ModelError: they have another, such as 0 to 255.
    """
    if not colour.numel():
        return
    low, high = (float(end) for end in colour.aminmax())
    if low < _COLOUR_LIMITS[0] or high > _COLOUR_LIMITS[1]:
        worst = low if low < _COLOUR_LIMITS[0] else high
        remedy = "divide by 255" if 0 < worst <= 255 else "draw it from a distribution that stays there, or clamp it"
        raise ModelError(f"expected {name} in 0..1, got {worst:g}; {remedy}.")


AnyPart = TypeVar("AnyPart")


def select_scenes(part: AnyPart, scenes: slice | Tensor) -> AnyPart:
    """A dataclass with some of the scenes' rows of all its tensors; what has none is as it is."""
    if part is None:
        return part
    values = {k: v[scenes] for k, v in vars(part).items() if isinstance(v, Tensor)}
    return replace(cast(Any, part), **values)


def resolve(sprites: Sprites, present: Tensor) -> Layer:
    """Broadcast a ``Sprites`` to ``present (N, M)`` and check what a renderer relies on.

    Raises:
        ModelError: a value that is no number, a tensor that does not broadcast, a sprite index outside the atlas, a
            value that is not finite, or a tint of another scale than 0..1.
    """
    shape = present.shape

    def full(name, value, dtype=torch.float32, tail=()):
        try:
            value = torch.as_tensor(value, dtype=dtype).detach()
        except (TypeError, ValueError):
            raise ModelError(
                f"expected Sprites({sprites.kinds!r}).{name} as a number or a tensor, got {value!r}; draw with "
                "values of sites, such as x = pyro.sample(...)."
            ) from None
        try:
            value = value.expand(*shape, *tail)
        except RuntimeError:
            raise ModelError(
                f"expected Sprites({sprites.kinds!r}).{name} to broadcast to (scenes, nodes) = {tuple(shape)}, "
                f"got shape {tuple(value.shape)}."
            ) from None
        shown = value[present]
        if value.is_floating_point() and not torch.isfinite(shown).all():
            raise ModelError(f"expected finite values in Sprites({sprites.kinds!r}).{name}, got NaN or infinity.")
        if name == "tint":
            check_colour(f"Sprites({sprites.kinds!r}).tint", shown)
        return value.contiguous()

    index = full("sprite", sprites.sprite, torch.int64)
    chosen = index[present]
    if chosen.numel() and not (0 <= int(chosen.min()) and int(chosen.max()) < len(sprites.atlas)):
        raise ModelError(
            f"expected sprite indices of {sprites.kinds!r} in 0..{len(sprites.atlas) - 1}, "
            f"got {int(chosen.min())}..{int(chosen.max())}."
        )
    scale_y = sprites.scale if sprites.scale_y is None else sprites.scale_y
    layer = Layer(
        atlas=sprites.atlas,
        present=present,
        sprite=index,
        x=full("x", sprites.x),
        y=full("y", sprites.y),
        angle=full("angle", sprites.angle),
        scale_x=full("scale", sprites.scale),
        scale_y=full("scale_y", scale_y),
        tint=full("tint", sprites.tint, tail=(3,)),
        labelled=sprites.labelled,
        kinds=(sprites.kinds,) if isinstance(sprites.kinds, str) else tuple(sprites.kinds),
    )
    if not sprites.keypoints:
        return layer
    points = [[full(f"keypoints[{name!r}]", each) for each in pair] for name, pair in sprites.keypoints.items()]
    return replace(
        layer,
        keypoint_names=tuple(sprites.keypoints),
        keypoints=torch.stack([_on_canvas(layer, u.double(), v.double()) for u, v in points], 2),
    )


def _on_canvas(layer: Layer, u: Tensor, v: Tensor) -> Tensor:
    """Where points of the sprites are, ``(N, M, 2)``; ``u, v (N, M)`` are shares of a sprite's width and height."""
    sizes = torch.tensor([sprite.shape[1::-1] for sprite in layer.atlas.sprites], dtype=torch.float64)
    width, height = sizes[layer.sprite.clamp(0, len(sizes) - 1)].unbind(-1)
    right, down = (u - 0.5) * width * layer.scale_x, (v - 0.5) * height * layer.scale_y
    cos, sin = layer.angle.double().cos(), layer.angle.double().sin()
    return torch.stack([layer.x + cos * right + sin * down, layer.y - sin * right + cos * down], -1)
