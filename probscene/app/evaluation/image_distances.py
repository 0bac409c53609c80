"""FID and KID of a run's scenes to the target's images, beside the floor: two halves of the target.

FID depends on the number of images, so every figure here is of as many on either side: no more than half of the
target, and than were asked for. Generated images are compared with one half, and that half with the other. Axis
letters: L images, m images a side.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch

from probscene.dataset import Images
from probscene.errors import DataError, ProbsceneError

from ..fitting.run import RunFolder
from ..fitting.scene_features import features_in, features_of, network
from .sources import LEARNT, before

IMAGES = 1000
Distances = dict[str, tuple[Any, ...]]
"""By ``prior``, ``start`` where it is another policy, ``learnt`` and ``floor``: the ``Figure`` of FID and of KID."""


def image_distances(
    run: RunFolder,
    target: Images,
    choices: Sequence[str],
    progress: Callable[[str, int, int, str], None],
    num: int = IMAGES,
    seed: int = 0,
) -> dict[str, Distances]:
    """The distances by the name of the network that sees the images.

    Args:
        choices: networks, see ``seen.network``.
        num: m at most.

    Raises:
        ProbsceneError: fewer than 2 images asked for, a network that there is not; see ``features_of``.
        DataError: fewer than 4 images in the target.
    """
    if not choices:
        return {}
    if num < 2:
        raise ProbsceneError(f"Expected at least 2 images to compare, actual {num}.")
    if len(target) < 4:
        raise DataError(f"Expected at least 4 images in {target.path} for FID and KID, actual {len(target)}.")
    from probscene.inference.judging.image_metrics import fid, kid  # torchmetrics takes seconds to import

    nets = [network(choice, run) for choice in choices]
    m = min(num, len(target) // 2)
    order = torch.randperm(len(target), generator=torch.Generator().manual_seed(seed))
    policies = {**before(run.model), LEARNT: run.guide}
    done, total = 0, len(nets) * (len(target) + len(policies) * m)

    def each(images):
        nonlocal done
        done += images
        progress("comparing", done, total, "")

    found = {}
    for name, net in nets:
        real = features_in(run, target, net, each)[order]
        sides = {source: features_of(run, policy, m, net, seed, each) for source, policy in policies.items()} | {
            "floor": real[m : 2 * m]
        }
        found[name] = {
            source: (fid(real[:m], side, name, seed=seed), kid(real[:m], side, name, seed=seed))
            for source, side in sides.items()
        }
    return found
