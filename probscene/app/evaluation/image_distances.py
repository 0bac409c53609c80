"""KID and FID of a run's scenes to the target's images, and their noise floor: those of two halves of the target.

FID depends on the number of images, so all its figures are of as many on either side: no more than half of the target,
and than were asked for. Generated images are compared with one half, and that half with the other. Where all images
are asked for, as many generated ones are compared with all of them, and the floor is extrapolated from the halves: FID
of two samples of one distribution falls as one over their number [1].

KID has no bias. It takes all of the target's images and, to narrow its interval, up to four times as many generated
ones, no more on either side than were asked for. Its floor is that of the halves. Axis letters: L images, m images a
side.

References:
    [1] Chong, Forsyth, *Effectively Unbiased FID and Inception Score*, 2020.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch

from probscene.dataset import Images
from probscene.errors import DataError, ProbsceneError

from ..fitting.run import RunFolder
from ..fitting.scene_features import features_in, features_of, network
from .sources import LEARNT, baseline_policies

if TYPE_CHECKING:
    from probscene.inference.statistics.image_metrics import ImageDistance

MAX_IMAGES = 1000
GENERATED_PER_REAL = 4  # of further generated images KID's interval hardly gets narrower
Distances = dict[str, tuple[Any, ...]]
"""By ``prior``, ``start`` where it is another policy, ``learnt`` and ``floor``: the ``ImageDistance`` of KID and of
FID."""


def image_distances(
    run: RunFolder,
    target: Images,
    choices: Sequence[str],
    progress: Callable[[str, int, int, str], None],
    num: int | None = MAX_IMAGES,
    seed: int = 0,
) -> dict[str, Distances]:
    """The distances by the name of the network whose features they are taken in.

    Args:
        choices: networks, see ``scene_features.network``.
        num: images a side, at most; all of the target's where None.

    Raises:
        ProbsceneError: fewer than 2 images asked for, a network that there is not; see ``features_of``.
        DataError: fewer than 4 images in the target.
    """
    if not choices:
        return {}
    if num is not None and num < 2:
        raise ProbsceneError(f"expected at least 2 images to compare, got {num}.")
    if len(target) < 4:
        raise DataError(f"expected at least 4 images in {target.path} for KID and FID, got {len(target)}.")
    from probscene.inference.statistics.image_metrics import fid, kid  # torchmetrics takes seconds to import

    nets = [network(choice, run) for choice in choices]
    L, half = len(target), len(target) // 2
    m = L if num is None else min(num, half)
    most = max(L, MAX_IMAGES) if num is None else num
    generated = max(m, min(most, GENERATED_PER_REAL * L))
    order = torch.randperm(L, generator=torch.Generator().manual_seed(seed))
    policies = {**baseline_policies(run.model), LEARNT: run.guide}
    done, total = 0, len(nets) * (L + len(policies) * generated)

    def advance(images: int) -> None:
        nonlocal done
        done += images
        progress("comparing", done, total, "")

    found = {}
    for name, net in nets:
        real = features_in(run, target, net, advance)[order]
        sides = {source: features_of(run, policy, generated, net, seed, advance) for source, policy in policies.items()}
        found[name] = {
            source: (kid(real[:most], side, name, seed=seed), fid(real[:m], side[:m], name, seed=seed))
            for source, side in sides.items()
        }
        h = min(m, half)
        floor, biased = (distance(real[:h], real[h : 2 * h], name, seed=seed) for distance in (kid, fid))
        found[name]["floor"] = floor, biased if h == m else extrapolate(biased, m)
    return found


def extrapolate(found: "ImageDistance", images: int) -> "ImageDistance":
    """An estimate of what FID of two samples of one distribution would be with another number of images a side [1].

    Args:
        found: FID of two such samples; it is taken to fall as one over their number.
        images: a side, of the estimate.
    """
    ratio = found.images / images
    value, low, high = (ratio * number for number in (found.value, found.low, found.high))
    sizes = {"images": images, "generated": images, "extrapolated_from": found.images}
    return found._replace(value=value, low=low, high=high, **sizes)


def caveat(found: "ImageDistance") -> str:
    """What limits a distance, in words; nothing where it rests on enough images."""
    if found.extrapolated_from is not None:
        return f"estimated from {found.extrapolated_from} images a side"
    fewest = min(found.images, found.generated)
    if fewest >= found.min_images:
        return ""
    if found.name == "FID":
        dimensions = f"FID of {fewest} images in {found.min_images - 1} dimensions"
        return f"{dimensions}: covariances of deficient rank, the figure is far too high"
    return f"KID of {fewest} images, fewer than the {found.min_images} of KID's subsets"


def record(found: "ImageDistance") -> dict[str, Any]:
    """For JSON."""
    known = found._asdict()
    return {name: known[name] for name in found._fields[:7]} | {"note": caveat(found)}
