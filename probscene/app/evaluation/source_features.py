"""Features of the target's images and of scenes of the prior, of the learnt structure alone and of all that was learnt:
where the objects of each class stand, and how the images look.

Image number i of a source and a seed is the one that ``generate`` would write. Axis letters: N images, C classes, E
features of looks, h w cells.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import ModelError
from probscene.inference.features.base import FeatureNet, LocatesObjects
from probscene.inference.features.counting.layout import LEAST, objects, scales
from probscene.inference.statistics.domain_shift import Patches
from probscene.inference.statistics.residual import Sample
from probscene.policy import Policy
from probscene.threads import threads

from ..fitting.plugins import inner
from ..fitting.run import RunFolder
from ..fitting.scene_features import images_of

NUM_IMAGES = 500  # of each source, at most
TARGET, LEARNT, STRUCTURE, PRIOR = "target", "learnt", "structure alone", "prior"
ALL = ""  # the objects of all classes


class Appearance(Protocol):
    """A network for looks, such as ``EfficientNetLite``."""

    def places(self, images: Tensor) -> tuple[Tensor, Tensor]: ...


class SourceFeatures(NamedTuple):
    """Features of the images of one source.

    Attributes:
        looks: ``(N, E)`` pooled features of EfficientNet-Lite.
        patches: ``(N, 1 + K, C)`` features of what stands out in each image, see ``EfficientNetLite.places``.
        layouts: of each class, and of all together, those images that have one; empty where the features do not say
            where objects are.
    """

    looks: Sample
    patches: Patches
    layouts: dict[str, Sample]


def policies(run: RunFolder) -> dict[str, Policy]:
    """The policy of each source, but for sources that are the same as one before: without learnt parameters structure
    alone is all that was learnt, and a guide that was rejected is the prior."""
    learnt, prior = run.guide, run.model.prior
    found = {LEARNT: learnt}
    if learnt.with_parameters is not None:
        found[STRUCTURE] = run.policy("structure")
    return found | ({} if learnt is prior else {PRIOR: prior})


def embed_sources(
    run: RunFolder,
    target: Images,
    net: FeatureNet,
    appearance: Appearance,
    callback: Callable[[int], None],
    num: int,
    seed: int = 0,
) -> dict[str, SourceFeatures]:
    """Features of up to ``num`` images of the target, evenly spread, and of ``num`` of each of the other sources.

    Args:
        net: the run's own.
        callback: called with the number of images of each batch.

    Raises:
        ModelError: a user's own network whose ``cells`` are none.
    """

    def embed(batches: Iterable[Tensor]) -> SourceFeatures:
        looks, patches, cells = [], [], []
        for images in batches:
            pooled, salient = appearance.places(images)
            looks.append(pooled)
            patches.append(salient)
            found = _cells(run, net, images)
            cells += [] if found is None else [found]
            callback(len(images))
        return SourceFeatures(
            Sample(torch.cat(looks).double().numpy()),
            torch.cat(patches).numpy(),
            _layouts(run, located_classes(run, net), torch.cat(cells)) if cells else {},
        )

    with threads(run.record["threads"]):
        rows = np.linspace(0, len(target) - 1, min(num, len(target))).astype(int)
        real = (torch.stack([target.load(row) for row in some]) for some in np.array_split(rows, -(-len(rows) // 64)))
        found = {TARGET: embed(real)}
        for name, policy in policies(run).items():
            found[name] = embed(images_of(run.model, policy, num, seed))
    found.setdefault(PRIOR, found[LEARNT])
    return found


def num_embedded(run: RunFolder, target: Images, num: int) -> int:
    """The number of images that ``embed_sources`` embeds."""
    return min(num, len(target)) + num * len(policies(run))


def located_classes(run: RunFolder, net: FeatureNet) -> tuple[str, ...]:
    """The classes whose objects the network finds; none where it does not say where they are."""
    own = inner(net)
    there = own.classes if isinstance(own, LocatesObjects) else ()
    return tuple(name for name in run.model.classes if name in there and name not in (*run.model.stuff, *run.unread))


def _cells(run: RunFolder, net: FeatureNet, images: Tensor) -> Tensor | None:
    """``(N, C, h, w)`` of the ``located_classes``."""
    names, own = located_classes(run, net), inner(net)
    if not names or not isinstance(own, LocatesObjects):
        return None
    classes, found = own.classes, own.cells(images)
    shape = tuple(found.shape)
    if len(shape) != 4 or shape[:2] != (len(images), len(classes)) or not (found >= 0).all():
        raise ModelError(
            f"expected of {type(own).__name__}.cells numbers that are not negative ({len(images)}, {len(classes)}, h, "
            f"w), got {shape}; see docs/how_to/own_parts.md."
        )
    return found[:, [classes.index(name) for name in names]]


def _layouts(run: RunFolder, names: tuple[str, ...], cells: Tensor) -> dict[str, Sample]:
    """Of images with ``cells (N, C, h, w)`` of the named classes."""
    groups = run.model.groups
    counted = [c for c, name in enumerate(names) if groups is None or name != groups.kind]
    maps = {name: cells[:, c] for c, name in enumerate(names)} if len(names) > 1 else {}
    maps = {ALL: cells[:, counted].sum(1), **maps}
    return {name: _layout(of_class) for name, of_class in maps.items()}


def _layout(cells: Tensor) -> Sample:
    number = objects(cells)
    there = number >= LEAST
    return Sample(scales(cells[there]).double().numpy(), number[there].round().numpy())
