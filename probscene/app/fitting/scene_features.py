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
from probscene.inference.features.base import EmbedsTarget, FeatureNet, embed_all
from probscene.inference.features.names import PRETRAINED, network_name
from probscene.inference.statistics.domain_shift import support_outliers
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.threads import threads

from ..chunks import CHUNK, as_written, draw_chunk
from ..loading import renderer_for
from .rendered_features import RENDERED_AT_ONCE, RenderedFeatures
from .run import RunFolder

RENDERS, ASKED = 320, 48  # renders, and images of the target, at most, by which ``domain_shift`` judges
NEIGHBOURS = 8
ALIKE = 0.5  # below this share no more renders are asked for
DOMAIN_SHIFT_SHARE = 0.87  # from this share on the target's images look unlike renders

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


def domain_shift(model: SceneModel, target: Images, progress: Callable[[int, int], None] | None = None) -> float:
    """The share of the target's images that lie outside the support of renders (``support_outliers``), by
    EfficientNet-Lite's pooled features or by the texture in its finest maps, whichever is less. Images of other
    structures and layouts lie among renders of the pretraining policy, at least in part; a camera's do not. Fewer
    renders do where they hold half of the images.

    Args:
        progress: told how many of how many images are looked at.
    """
    from probscene.inference.features.pretrained import EfficientNetLite  # torchvision takes seconds to import

    rows, look = np.linspace(0, len(target) - 1, min(ASKED, len(target))).astype(int), EfficientNetLite()
    total, of_renders, share = len(rows) + RENDERS, [], 1.0
    with threads(1):
        of_target = look.looks(torch.stack([target.load(row) for row in rows]))
        for images in images_of(model, model.pretraining_policy, RENDERS):
            of_renders.append(look.looks(images))
            drawn = [torch.cat(some).double().numpy() for some in zip(*of_renders, strict=True)]
            sides = zip(of_target, drawn, strict=True)
            share = min(
                float(support_outliers(real.double().numpy(), renders, NEIGHBOURS).mean()) for real, renders in sides
            )
            done = len(rows) + len(drawn[0])
            total = done if share < ALIKE else total
            if progress is not None:
                progress(done, total)
            if done == total:
                break
    return share


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
        if isinstance(net, EmbedsTarget):
            return _embed_labels(run, policy, num, net, seed, each)
        return embed_all(net, images_of(run.model, policy, num, seed), each)


def _embed_labels(run: RunFolder, policy: Policy, num: int, net: FeatureNet, seed: int, each: Each | None) -> Tensor:
    """Of the same scenes, by their labels."""
    observe, parts = RenderedFeatures(run.model, run.record["threads"]).observe(net), []
    for chunk, first in enumerate(range(0, num, CHUNK)):
        parts.append(observe(draw_chunk(run.model, policy, seed, chunk))[: num - first])
        if each is not None:
            each(len(parts[-1]))
    return torch.cat(parts)


def features_in(run: RunFolder, images: Images, net: FeatureNet, each: Each | None = None) -> Tensor:
    """Features ``(L, D)`` of real images.

    Raises:
        ProbsceneError: a feature is not finite.
    """
    if isinstance(net, EmbedsTarget):
        return net.embed_target(images.fingerprint)
    with threads(run.record["threads"]):
        return embed_all(net, images.batches(RENDERED_AT_ONCE), each, real=True)


def own_net(run: RunFolder) -> FeatureNet:
    """The feature network that the run has trained.

    Raises:
        RunError: it is not trained yet.
    """
    net = run.network()
    if net is None:
        raise RunError(f"expected the feature network in {run.path}, got none; continue with --resume.")
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
