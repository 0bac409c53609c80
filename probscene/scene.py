"""Scene graphs: parameters as Pyro sites on a plate of nodes, relative to the parent (section 3.1).

Axis letters: N scenes, M nodes.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar, cast

import pyro
import torch
from pyro.poutine.runtime import effectful
from torch import BoolTensor, Tensor

from .camera_effects import CameraEffects, EffectValue, sample_camera_effects
from .derivation import Derivation
from .drawing import Drawing, Layer, Sprites, resolve
from .errors import ModelError
from .grammar import Grammar
from .request import Objects, Request, resolve_values
from .scene_sites import seed_site
from .world import Camera, Ground, Light, Meshes, MeshLayer, World, resolve_ground, resolve_meshes, resolve_scene

AnyPrimitive = TypeVar("AnyPrimitive", Sprites, Meshes)
AnyLayer = TypeVar("AnyLayer", Layer, MeshLayer)


class SceneGraph:
    """The nodes of a batch of derived scenes. Build it inside ``pyro.plate("scenes", N, dim=-2)``.

    Args:
        grammar: the grammar.
        derivation: its derivations.
        max_nodes: M, for what needs one shape in every call, such as autoguides; as few as the scenes have where None.

    Attributes:
        kind: ``(N, M)`` int64, -1 pads.
        parent: ``(N, M)`` int64 node index, -1 for none.

    Raises:
        ModelError: a scene has more nodes than ``max_nodes``.
    """

    def __init__(self, grammar: Grammar, derivation: Derivation, max_nodes: int | None = None):
        if max_nodes is not None:
            derivation = _as_wide(grammar, derivation, max_nodes)
        self.grammar, self.derivation = grammar, derivation
        self.kind, self.parent = derivation.kind, derivation.parent
        self._plate = pyro.plate("nodes", self.kind.shape[1], dim=-1)

    def mask(self, *kinds: str) -> Tensor:
        """``(N, M)`` bool, the nodes of the named kinds."""
        wanted = {self.grammar.kind(name) for name in kinds}
        if wanted and len(wanted) == 1 + max(wanted) - min(wanted):  # ten times as fast as looking up
            return (self.kind >= min(wanted)) & (self.kind <= max(wanted))
        table = torch.zeros(len(self.grammar.kinds) + 1, dtype=torch.bool)  # the last is padding
        table[list(wanted)] = True
        return table[self.kind]

    @contextmanager
    def nodes(self, *kinds: str):
        """A plate over the M nodes, masked to the named kinds: sites are ``(N, M)``, and other nodes have log-prob 0.

        Raises:
            GrammarError: the grammar has no such object.
        """
        with self._plate, pyro.poutine.mask(mask=cast(BoolTensor, self.mask(*kinds))):
            yield

    def of_parent(self, value: Tensor | float, default: float = 0.0) -> Tensor:
        """Each node's parent's entry of ``value (N, M)``; ``default`` where there is no parent."""
        values = torch.as_tensor(value).expand(self.kind.shape)
        return cast(Callable[..., Tensor], _of_parent)(values, self.parent, default, name="of_parent")

    def rank(self, *kinds: str) -> Tensor:
        """``(N, M)`` int64, how many nodes of these kinds and of the same parent come before a node."""
        return self._siblings(*kinds).tril(-1).sum(-1)

    def count(self, *kinds: str) -> Tensor:
        """``(N, M)`` int64, how many nodes of these kinds have the same parent as a node."""
        return self._siblings(*kinds).sum(-1)

    def _siblings(self, *kinds: str) -> Tensor:
        mask = self.mask(*kinds)
        return (self.parent.unsqueeze(-1) == self.parent.unsqueeze(-2)) & mask.unsqueeze(-2)

    def build(
        self,
        *layers: Meshes,
        camera: Camera,
        light: Light | None = None,
        ground: Ground | None = None,
        photo: CameraEffects | None = None,
    ) -> World:
        """A 3D world of meshes to render; their order does not matter.

        Raises:
            ModelError: values of a wrong shape, out of range or not finite.
        """
        N = len(self.kind)
        camera, light = resolve_scene(camera, N), resolve_scene(light or Light(), N)
        photo, ground = (
            resolve_scene(photo or CameraEffects(), N),
            None if ground is None else resolve_ground(ground, N),
        )
        found = self._resolved(layers, resolve_meshes)
        return World(self.kind, self.grammar.kinds, found, camera, light, ground, photo)

    def draw(
        self,
        *layers: Sprites,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        photo: CameraEffects | None = None,
    ) -> Drawing:
        """What to render: layers from the back to the front, and what a camera makes of them.

        Raises:
            ModelError: values of a wrong shape, out of range or not finite.
        """
        photo = None if photo is None else resolve_scene(photo, len(self.kind))
        return Drawing(self.kind, self.grammar.kinds, self._resolved(layers, resolve), background, photo)

    def request(
        self, *objects: Objects, scene: Mapping[str, Any] | None = None, photo: CameraEffects | None = None
    ) -> Request:
        """What the model's generator is to draw (``SceneModel.generator``), with a seed for each scene, the site
        ``request.seed``.

        Call it outside ``nodes(...)``.

        Args:
            scene: values of the scene by name: numbers, or tensors ``(N, 1)``, or ``(N, 1, k)`` for lists of k numbers.

        Raises:
            ModelError: values of a wrong shape or not finite; it is called inside ``nodes(...)``.
        """
        N, found = len(self.kind), []
        for each in objects:
            kinds = (each.kinds,) if isinstance(each.kinds, str) else each.kinds
            found.append(resolve_values(f"Objects({each.kinds!r})", each.values, self.mask(*kinds)))
        of_scene = resolve_values("the scene", scene or {}, torch.ones(N, 1, dtype=torch.bool))
        effects = None if photo is None else resolve_scene(photo, N)
        seed = seed_site("request.seed", N, "scene.request(...)").squeeze(1)
        return Request(self.kind, self.grammar.kinds, self.parent, seed, tuple(found), (of_scene,), effects)

    def photo(  # noqa: PLR0913 - one for each effect
        self,
        *,
        exposure: EffectValue | None = None,
        contrast: EffectValue | None = None,
        saturation: EffectValue | None = None,
        red_gain: EffectValue | None = None,
        blue_gain: EffectValue | None = None,
        vignette: EffectValue | None = None,
        blur: EffectValue | None = None,
        noise: EffectValue | None = None,
        jpeg_quality: EffectValue | None = None,
    ) -> CameraEffects:
        """Camera effects on each image, for ``draw(..., photo=...)`` or ``build(..., photo=...)``.

        A range, such as ``blur=(0.0, 2.0)``, or a distribution makes a site with one value a scene, ``photo.blur``
        and so on, which is learnt like the others. A number is the same in all images; what is left out keeps the image
        as it is. Noise adds a site ``photo.seed``, which keeps its prior. The values are those of ``CameraEffects``.

        Call it outside ``nodes(...)``.

        Raises:
            ModelError: a range that is none or outside a value's limits; it is called inside ``nodes(...)``.
        """
        given = {
            "exposure": exposure, "contrast": contrast, "saturation": saturation, "red_gain": red_gain,
            "blue_gain": blue_gain, "vignette": vignette, "blur": blur, "noise": noise, "jpeg_quality": jpeg_quality,
        }  # fmt: skip
        return sample_camera_effects(len(self.kind), given)

    def _resolved(
        self, layers: Iterable[AnyPrimitive], resolve: Callable[[AnyPrimitive, Tensor], AnyLayer]
    ) -> tuple[AnyLayer, ...]:
        found = []
        for layer in layers:
            kinds = (layer.kinds,) if isinstance(layer.kinds, str) else layer.kinds
            if kinds == ():
                found.append(resolve(replace(layer, labelled=False), _decorated(layer, len(self.kind))))
            else:
                mask = self.mask(*kinds)
                found.append(resolve(layer, mask if layer.present is None else mask & layer.present))
        return tuple(found)


def _as_wide(grammar: Grammar, derivation: Derivation, max_nodes: int) -> Derivation:
    derivation = derivation.trimmed()
    most = derivation.kind.shape[1]
    if most > max_nodes:
        raise ModelError(
            f"expected scenes of at most max_nodes = {max_nodes} nodes, got {most}; give SceneGraph a larger "
            "one, or none."
        )
    return derivation.padded(grammar, 0, max_nodes)


@effectful(type="of_parent")
def _of_parent(value: Tensor, parent: Tensor, default: float) -> Tensor:
    """``SceneGraph.of_parent``; a handler sees that the program has asked."""
    return value.gather(1, parent.clamp(min=0)).where(parent >= 0, default)


def _decorated(layer: Sprites | Meshes, num_scenes: int) -> Tensor:
    """What of a decoration is there, ``(N, M)`` bool."""
    present = layer.present
    if present is None or present.ndim != 2 or present.shape[0] != num_scenes or present.dtype != torch.bool:
        actual = "none" if present is None else f"{present.dtype} {tuple(present.shape)}"
        raise ModelError(
            f"expected {type(layer).__name__} of no kind with present, bool ({num_scenes} scenes, how many), "
            f"got {actual}; say which of the decoration is drawn."
        )
    return present
