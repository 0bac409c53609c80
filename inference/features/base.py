"""Feature networks: what they are trained on and how images enter them.

They are trained on the model's own renders only, whose labels come free. Axis letters: N scenes, M nodes, D
features, C H W.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from probscene.batch import RenderBatch
from probscene.errors import ProbsceneError
from probscene.model import SceneModel

from ..divergence import Divergence
from ..training import Training


class Examples(NamedTuple):
    """Labelled renders, ready for training.

    Attributes:
        image: ``(N, 1 or 3, H, W)`` uint8, grey where the model's colour carries nothing.
        label: ``(N, M)`` int64 class of each node, -1 where it has none or cannot be seen.
        centre: ``(N, M, 2)`` float32 x and y of the middle of its whole silhouette, pixels.
        size: ``(N, M, 2)`` float32 width and height of that silhouette, pixels.
        visible: ``(N, M)`` visible fraction.
        middle: ``(N, M)`` float32, where along the groups' axis the middle of each node's group is, pixels; -1 where it
            has none. Empty if the model has no groups.
        instance: ``(N, H, W)`` int16, node index + 1. Empty if the model has no groups.
    """

    image: Tensor
    label: Tensor
    centre: Tensor
    size: Tensor
    visible: Tensor
    middle: Tensor
    instance: Tensor


class FeatureNet(Protocol):
    """What turns images into features. A ``torch.nn.Module`` has its ``state_dict`` kept in the run; anything else has
    no state.

    Laws: an image's features do not depend on the other images of the batch, nor on the call.

    Attributes:
        names: one name a feature, D.
    """

    names: tuple[str, ...]

    def embed(self, images: Tensor) -> Tensor:
        """Features ``(N, D)`` float32, finite, of images ``(N, C, H, W)`` uint8, N >= 0. Renders come with C = 3;
        target images with C = 1 where the model's colour carries nothing, else 3.

        A network may have more beside it: see ``EmbedsReal``, ``EmbedsLabels``, ``LocatesObjects`` and
        ``CountsObjects``."""
        ...


@runtime_checkable
class EmbedsReal(Protocol):
    """A ``FeatureNet`` that looks at target images in another way than at renders."""

    def embed_real(self, images: Tensor) -> Tensor:
        """``FeatureNet.embed`` of target images."""
        ...


@runtime_checkable
class EmbedsTarget(Protocol):
    """A ``FeatureNet`` that knows the features of the target's images, and of no others."""

    def embed_target(self, fingerprint: str) -> Tensor:
        """Features ``(L, D)`` of the images with this fingerprint.

        Raises:
            DataError: they are not the target's.
        """
        ...


@runtime_checkable
class EmbedsLabels(Protocol):
    """A ``FeatureNet`` whose features of renders come from their labels, where these are at hand. Where its
    ``uses_labels`` is true, it does not look at their images, which may be black."""

    def embed_from_labels(self, drawn: Examples) -> Tensor:
        """Features ``(N, D)``."""
        ...


@runtime_checkable
class LocatesObjects(Protocol):
    """A ``FeatureNet`` that finds objects of some classes, by which a verdict on layout goes."""

    classes: Sequence[str]

    def cells(self, images: Tensor) -> Tensor:
        """``(N, classes, h, w)`` how many objects of each class each cell of the image holds."""
        ...


@runtime_checkable
class Placeable(Protocol):
    """A ``FeatureNet`` that computes on a device of choice. Others compute where they are."""

    def place(self, device: torch.device) -> None:
        """From now on compute there; images, labels and features stay on the CPU."""
        ...


@runtime_checkable
class CountsObjects(Protocol):
    """A ``FeatureNet`` whose features count objects: 1 in a feature is ``unit`` of them, a number or ``(D,)``."""

    unit: float | Tensor


Draw = Callable[[int], Examples]
ImageCallback = Callable[[int, int], None]
"""Called with how many images have been embedded, and of how many."""


class Renders(Protocol):
    """Renders of a model's scenes for a feature network to be trained on; each call draws new ones.

    Attributes:
        model: the scene model.
    """

    model: SceneModel

    def draw(self, num: int, beyond_prior: bool = False) -> Examples:
        """``num`` labelled renders of the prior; or of the policy that guides are pretrained on, which may have more of
        everything."""
        ...

    def draw_twice(self, num: int) -> Examples:
        """Labelled renders of ``num`` structures, and as many more of the same structures, their parameters anew; of
        the policy that guides are pretrained on."""
        ...

    def embed_twice(self, num: int, net: FeatureNet) -> tuple[Tensor, Tensor]:
        """``draw_twice`` through a network: two times ``(num, D)`` features."""
        ...

    def object_size(self) -> float:
        """Pixels: a tenth of the visible objects of the prior's renders are smaller; infinite where there are none."""
        ...


class Labelled(NamedTuple):
    """A handful of the target's images, K of them, that a person has labelled.

    Attributes:
        images: ``(K, C, H, W)`` uint8.
        counts: ``(K, classes)`` int64 objects.
        classes: the names of those that are labelled, in the model's order.
        rows: ``(K,)`` int64, which of the target's images they are.
        boxes: of each image ``(n, 5)``: the number of the class in ``classes``, then x0, y0, x1, y1 in pixels of the
            canvas; None where only counts are known.
    """

    images: Tensor
    counts: Tensor
    classes: tuple[str, ...]
    rows: Tensor
    boxes: tuple[Tensor, ...] | None


class Detections(NamedTuple):
    """What a detector found in the target's images.

    Attributes:
        image, label: ``(n,)`` int64 the number of the image of each, and its class in the model's order.
        box: ``(n, 4)`` x0, y0, x1, y1 in pixels of the canvas.
        score: ``(n,)``.
        images: L.
        classes: numbers of those that the detector knows.
    """

    image: np.ndarray
    label: np.ndarray
    box: np.ndarray
    score: np.ndarray
    images: int
    classes: tuple[int, ...]

    def counts(self, c: int, min_score: float) -> np.ndarray:
        """``(L,)`` of a class, from a score on."""
        kept = (self.label == c) & (self.score >= min_score)
        return np.bincount(self.image[kept], minlength=self.images)


class Photographs(Protocol):
    """The target's images, for a feature network that looks at them before it is used.

    Attributes:
        fingerprint: of the images, SHA-256 hexadecimal.
        detections: that somebody's detector made in them; None where there are none.
    """

    fingerprint: str
    detections: Detections | None

    @property
    def labelled(self) -> Labelled | None:
        """Those that are labelled; None where none is."""
        ...

    def subset(self, max_images: int) -> Tensor:
        """At most so many of them, evenly spread, ``(L, C, H, W)`` uint8."""
        ...


class Features(Protocol):
    """A choice of features: how its network is built and trained, and what suits it. Subclass it, give ``build``, and
    what else differs from the defaults.

    Attributes:
        name: in records and messages; another name is another choice.
        resolution: features that differ by less count as equal in the verdict, such as 0.5 of a count.
        pretrained: whether the network has learnt from photographs; a verdict then does not advise to take such a one.
        images: how many renders its training draws, at most, for a forecast of how long a fit takes.
        takes_labels: whether ``adapt`` makes use of ``Photographs.labelled``; with others ``fit --labels`` is an error.
        takes_readings: whether it needs ``Photographs.detections``; with others ``fit --readings`` is an error.
    """

    name: str
    resolution: float = 0.0
    pretrained: bool = False
    images: int = 0
    takes_labels: bool = False
    takes_readings: bool = False

    def build(self, model: SceneModel) -> FeatureNet:
        """The network, untrained or pretrained; the random numbers it takes are the run's. Called once a fit, and again
        whenever the run is opened: a state that was kept is then loaded into it."""
        ...

    def training(
        self, net: FeatureNet, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> Training | None:
        """How the network is trained in place; None where there is nothing to train.

        Args:
            photographs: opens the target; a network that learns from it is bound to it, see ``target_fingerprint``.
            seed: of everything random.
        """
        return None

    def adapt(self, net: FeatureNet, photographs: Callable[[], Photographs], callback: ImageCallback) -> dict[str, Any]:
        """Suit a trained network to the target's images, in place, such as by choosing how counts are read in them.

        Args:
            photographs: opens the target; a network that learns from it is bound to it, see ``target_fingerprint``.
            callback: called with how many images have been embedded, and of how many.

        Returns:
            What was found, for JSON; of features that count, under ``"classes"``, a record of each class with
            ``"readable"``, ``"because"`` and ``"visible"``, the share of an object that counts.
        """
        return {}

    def divergence(self, net: FeatureNet, chosen: Divergence) -> Divergence:
        """The divergence that suits the network's features, given the fit's own."""
        return chosen

    def target_fingerprint(self, net: FeatureNet) -> str:
        """The fingerprint of the photographs that the network has learnt from, empty for none: it is used with no
        others."""
        return ""

    def settings(self, config: Any) -> dict[str, Any]:
        """Values of a fit's configuration that suit these features, by their paths, such as ``{"structure.num_scenes":
        150}`` for a slow network; what the user sets comes after. ``config`` is the ``FitConfig`` without them."""
        return {}


class Fixed(Features):
    """A network as it is: nothing is trained.

    Args:
        net: with ``names`` and ``embed``.
        name: its class's where none is given.
    """

    def __init__(self, net: FeatureNet, name: str = ""):
        self.net, self.name = net, name or type(net).__name__

    def build(self, model: SceneModel) -> FeatureNet:
        """The network."""
        return self.net


def examples(batch: RenderBatch, classes: Tensor, group: Tensor | None = None, along: str = "y") -> Examples:
    """The labels of a rendered batch.

    Args:
        batch: from a renderer.
        classes: ``(kinds + 1,)`` int64, the class of each kind of the grammar, -1 for none; the last entry is -1.
        group: ``(N, M)`` int64, the node that each node is counted with, -1 for none; see ``derivation.group_of``.
        along: the axis along which groups follow one another, ``"x"`` or ``"y"``.
    """
    label = classes[batch.kind].masked_fill(batch.pixels == 0, -1)
    box = batch.amodal_box
    centre = (box[..., :2] + box[..., 2:]) / 2
    middle, instance = torch.zeros(len(label), 0), torch.zeros(len(label), 0, 0, dtype=torch.int16)
    if group is not None:
        middle = centre[..., "xy".index(along)].gather(1, group.clamp(min=0)).where(group >= 0, -1.0)
        instance = batch.instance
    return Examples(batch.image, label, centre, box[..., 2:] - box[..., :2], batch.visible, middle, instance)


def class_table(kinds: tuple[str, ...], classes: tuple[str, ...]) -> Tensor:
    """The ``classes`` argument of ``examples``: index ``-1`` (padding) falls on the last entry."""
    return torch.tensor([classes.index(kind) if kind in classes else -1 for kind in kinds] + [-1])


def enter(images: Tensor, channels: int, reduce: int) -> Tensor:
    """Images as a network reads them: ``(N, channels, H/reduce, W/reduce)`` float32 in 0..1.

    Args:
        images: ``(N, 1 or 3, H, W)`` uint8.
        reduce: block average, 1, 2, 4, ...; H and W are padded with zeros to a multiple.
    """
    x = images[:, :channels]
    N, C, H, W = x.shape
    if H % reduce or W % reduce:
        x = torch.nn.functional.pad(x, (0, -W % reduce, 0, -H % reduce))
    if reduce > 1:
        # Sums of at most 64 bytes fit in 16 bits; two passes over small integers beat pooling in floating point. Rows
        # go first: they lie whole in memory, planar or interleaved.
        if reduce > 8:
            raise ProbsceneError(f"expected reduce at most 8, got {reduce}.")
        rows = x[..., ::reduce, :].to(torch.int16)
        for i in range(1, reduce):
            rows += x[..., i::reduce, :]
        x = rows[..., ::reduce]
        for i in range(1, reduce):
            x = x + rows[..., i::reduce]
    return x.float() * (1 / (255 * reduce * reduce))


def embed_real(net: FeatureNet, images: Tensor) -> Tensor:
    """Features ``(L, D)`` of target images, which a network may look at in another way than at renders."""
    return net.embed_real(images) if isinstance(net, EmbedsReal) else net.embed(images)


def needs_images(net: FeatureNet | EmbedsLabels) -> bool:
    """Whether a network looks at the images of renders, and not at their labels alone."""
    return not getattr(net, "uses_labels", False)


def objects_counted(net: FeatureNet, features: Tensor) -> Tensor:
    """Features ``(N, D)`` in objects, where they count some."""
    return features * net.unit if isinstance(net, CountsObjects) else features


@torch.no_grad()
def embed_all(
    net: FeatureNet, batches: Iterable[Tensor], callback: Callable[[int], None] | None = None, real: bool = False
) -> Tensor:
    """Features ``(L, D)`` of a stream of image batches; ``callback`` is called with how many more images are done.

    Args:
        real: whether they are the target's images.

    Raises:
        ProbsceneError: a feature is not finite.
    """
    features, done = torch.zeros(0, len(net.names)), 0
    for images in batches:
        some = embed_real(net, images) if real else net.embed(images)
        if done + len(some) > len(features):  # small tensors that stay would keep the large ones' memory in pieces
            more = features.new_empty(max(done, 16 * len(some)), len(net.names))
            features = torch.cat([features[:done], more])
        features[done : done + len(some)] = some
        done += len(some)
        if callback is not None:
            callback(len(images))
    features = features[:done].clone()
    if not torch.isfinite(features).all():
        raise ProbsceneError("expected finite features, got NaN or infinity; train the feature network again.")
    return features


def slow_settings(config: Any) -> dict[str, Any]:
    """What suits a network that takes about 20 ms an image on one core where a preset's own takes 1: fewer scenes, each
    drawn once, and at so noisy a gradient half the step. Marginals, far sharper than the joint density, say of
    photographs only that they are none. Features come in units of their bandwidth, and the kernel takes them so."""
    return {
        "structure.batches": 40,
        "structure.num_scenes": 150,
        "structure.draws_per_structure": 1,
        "structure.learning_rate": min(config.structure.learning_rate, 5e-3),
        "divergence.marginal_variance": None,
        "divergence.anscombe": False,
        "divergence.variance": None if getattr(config.divergence, "variance", 1.0) is None else 1.0,
    }
