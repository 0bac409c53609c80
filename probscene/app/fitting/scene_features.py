"""Scenes and photographs as a feature network sees them: what judges a fit by its images.

Scene number i of a policy and a seed is image number i that ``generate`` would write, whatever the number of scenes.
Axis letters: N scenes, L images, D features, C H W.
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import RunError
from probscene.inference.features.base import FeatureNet, embed_all
from probscene.inference.features.names import PRETRAINED, network_name
from probscene.inference.judging.support import told_apart
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import sample
from probscene.threads import threads

from ..chunks import CHUNK, as_written, chunk_randomness, draw_chunk
from ..loading import renderer_for
from .observer import RENDERED_AT_ONCE
from .run import RunFolder

ASKED = 24  # renders, and as many of the target's images, that are asked where they come from
UNLIKE = 0.95  # how often they show it, from which on they are told apart

Each = Callable[[int], None]
"""Told how many more images are done."""


def fingerprint(target: Images) -> Tensor:
    """Of the images, ``(32,)`` uint8: as a run's tensors keep what says which images they are of."""
    return torch.tensor(list(bytes.fromhex(target.fingerprint)), dtype=torch.uint8)


def kept_features(run: RunFolder, target: Images | None) -> Tensor | None:
    """The features ``(L, D)`` of its images that the fit kept, in the network's units; None where there are none, or
    where the target's images are others. Without a target they are the fit's."""
    kept = run.read_tensors("real")
    if kept is None or (target is not None and not torch.equal(kept["fingerprint"], fingerprint(target))):
        return None
    return kept["features"]


def images_of(model: SceneModel, policy: Policy, num: int, seed: int = 0) -> Iterator[Tensor]:
    """Renders of ``num`` scenes with structures from ``policy``, in batches ``(n, channels, H, W)`` uint8 as a reader
    of their files would have them."""
    render = renderer_for(model)
    for chunk, first in enumerate(range(0, num, CHUNK)):
        scenes = draw_chunk(model, policy, seed, chunk)
        yield as_written(model, render(scenes.drawing[: num - first]).image)


def unlike(model: SceneModel, target: Images) -> float:
    """How surely the target's images are told from the model's renders: see ``told_apart``, by EfficientNet-Lite's
    pooled features and by the texture in its finest maps, whichever tells less. Other structures do not tell images
    apart so well as a camera does."""
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    with threads(1), chunk_randomness(0, 0):
        drawn = renderer_for(model)(sample(model, model.pretraining_policy, ASKED).drawing).image
    rows = np.linspace(0, len(target) - 1, min(ASKED, len(target))).astype(int)
    sides = (as_written(model, drawn), torch.stack([target.load(row) for row in rows]))
    looks = [EfficientNetLite().looks(images) for images in sides]
    return min(told_apart(one.double().numpy(), other.double().numpy()) for one, other in zip(*looks, strict=True))


def features_of(
    run: RunFolder, policy: Policy, num: int, net: FeatureNet, seed: int = 0, each: Each | None = None
) -> Tensor:
    """Features ``(num, D)`` of rendered scenes with structures from ``policy``; the same for the same seed.

    Args:
        policy: ``run.model.prior``, ``run.guide`` or any other over the model's grammar.
        net: such as ``network`` gives.

    Raises:
        ProbsceneError: a feature is not finite.
    """
    with threads(run.record["threads"]):
        return embed_all(net, images_of(run.model, policy, num, seed), each)


def features_in(run: RunFolder, images: Images, net: FeatureNet, each: Each | None = None) -> Tensor:
    """Features ``(L, D)`` of real images.

    Raises:
        ProbsceneError: a feature is not finite.
    """
    with threads(run.record["threads"]):
        return embed_all(net, images.batches(RENDERED_AT_ONCE), each, real=True)


def own_net(run: RunFolder) -> FeatureNet:
    """The feature network that the run has trained.

    Raises:
        RunError: it is not trained yet.
    """
    net = run.network()
    if net is None:
        raise RunError(f"Expected the feature network in {run.path}, actual none; go on with --resume.")
    return net


def network(choice: str, run: RunFolder) -> tuple[str, FeatureNet]:
    """A feature network and its name, from ``run`` or one of ``names.CHOICES``.

    Raises:
        ProbsceneError: another word.
        DataError: see ``pretrained``.
        RunError: see ``own_net``.
    """
    if choice == "run":
        return "run", own_net(run)
    name = PRETRAINED[network_name(choice, ("run",))]
    from probscene.inference.features.pretrained import pretrained  # torchvision takes seconds to import

    return name, pretrained(choice)
