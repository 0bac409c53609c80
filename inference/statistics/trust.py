"""Can this fit be trusted? Figures and a verdict from features alone, without labels.

Whether the sets differ, and which differences would be seen, comes from resamples of both (``difference_test``). What a
nearest neighbour is and which shares are sure comes from halves of the real set and from binomial limits. ``verdict``
holds the rules. Axis letters: N generated, L real, P prior, D features.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probscene.errors import ProbsceneError

from .difference_test import difference_test
from .domain_shift import Fidelity, Mask, Places, fidelity, foreign, likeness, strange, unlike_floor
from .modes import effective_share, interval, modes
from .two_sample import (
    EXAMINED,
    NEEDED,
    EnergyTest,
    Features,
    check_features,
    energy_test,
    marginals,
    permutation_p,
    principal,
)
from .verdict import PRETRAINED_REMEDY, REMEDY, Figures, Gap, Verdict, decide

SHOWN = 16  # images of each side that are least like the other


@dataclass(frozen=True, eq=False)
class Trust:
    """A judged fit.

    Attributes:
        verdict: in words.
        because: one sentence with the figures that decided.
        figures: all of them.
        pretrained: whether the features are a pretrained network's.
    """

    verdict: Verdict
    because: str
    figures: Figures
    pretrained: bool = False

    @property
    def remedy(self) -> str:
        """What to do."""
        usual = REMEDY[self.verdict]
        return PRETRAINED_REMEDY.get(self.verdict, usual) if self.pretrained else usual

    def record(self) -> dict[str, Any]:
        """Everything, for JSON."""
        found = self.figures
        modes = found.modes
        return {
            "verdict": str(self.verdict),
            "because": self.because,
            "remedy": self.remedy,
            "difference": _difference(found),
            "images": dict(zip(("generated", "real", "prior"), found.numbers, strict=True)),
            "distance": _apart(found.joint),
            "largest_single_feature": {"name": found.names[found.single.worst], **_apart(found.single.largest)},
            "single_features": dict(zip(found.names, found.single.each.tolist(), strict=True)),
            "distance_from_prior": None if found.from_prior is None else _apart(found.from_prior),
            "p_value": found.p_value,
            "unlike": _gap(found.real_unmatched),
            "outside": _gap(found.real_out_of_support),
            "strange": _gap(found.generated_unmatched),
            "modes": [
                {
                    "centre": dict(zip(found.names, modes.centre[k].tolist(), strict=True)),
                    "real": float(modes.real[k]),
                    "generated": float(modes.generated[k]),
                    "prior": None if np.isnan(modes.prior[k]) else float(modes.prior[k]),
                    "ratio": [_finite(float(modes.low[k])), _finite(float(modes.high[k]))],
                    "lost": bool(modes.lost[k]),
                    "missing": bool(modes.missing[k]),
                }
                for k in np.argsort(-modes.real)
            ],
            "foreign": {"share": found.foreign, "by_appearance": found.by_appearance},
            "effective_share": {"generated": found.effective, "floor": found.effective_floor},
            **{
                key: {"generated": getattr(found.fidelity, key), "floor": getattr(found.fidelity_floor, key)}
                for key in Fidelity._fields
            },
        }


def trust(
    generated: ArrayLike,
    real: ArrayLike,
    prior: ArrayLike | None = None,
    names: tuple[str, ...] | None = None,
    resolution: float = 0.0,
    places: tuple[Places, Places] | None = None,
    seed: int = 0,
    pretrained: bool = False,
) -> Trust:
    """Judge a fit.

    Args:
        generated: ``(N, D)`` features of the guide's scenes; the verdict is surer with 1,000 and more.
        real: ``(L, D)`` of the target's images.
        prior: ``(P, D)`` of the scenes that the guide set out from.
        names: of the features.
        resolution: features that differ by less mean the same: 0.5 for counts.
        places: features of what stands out in some real images and in some scenes, to tell another domain by; see
            ``strange``.
        seed: of the splits.
        pretrained: whether the features are a pretrained network's, which advice goes by.

    Raises:
        DataError: see ``check_features``: fewer real images than are needed, all alike, or not finite.
        ProbsceneError: fewer scenes than are needed, or features of another width.
    """
    real = check_features(real)
    D = real.shape[1]
    scenes = [_scenes(generated, D, "generated"), *([] if prior is None else [_scenes(prior, D, "prior")])]
    reduced = principal([real, *scenes])
    if reduced[0].shape[1] != D or names is None:
        names = tuple(
            f"feature {j}" if reduced[0].shape[1] == D else f"component {j}" for j in range(len(reduced[0].T))
        )
    whole, (generated, *before) = reduced[0], reduced[1:]
    before = before[0] if before else None
    rng = np.random.default_rng(seed)
    which = rng.permutation(len(whole))[: min(len(whole), len(generated), EXAMINED)]
    some = whole[which]
    first, second = some[: len(some) // 2], some[len(some) // 2 : len(some) // 2 * 2]

    read_generated, read_whole, read_some = (_read(each, resolution, rng) for each in (generated, whole, some))
    joint, single = energy_test(generated, whole, seed=seed), marginals(read_generated, read_whole, seed=seed)
    from_prior = None if before is None else energy_test(generated, before, seed=seed)
    to_generated = likeness(some, generated, resolution=resolution)
    to_prior = None if before is None else likeness(some, before, resolution=resolution)
    to_real = likeness(generated, some, resolution=resolution)
    floor = unlike_floor(some, resolution=resolution, seed=seed)
    nowhere = ~to_generated.like if to_prior is None else ~to_generated.like & ~to_prior.like
    nearest = to_generated.nearest if to_prior is None else np.minimum(to_generated.nearest, to_prior.nearest)
    found = modes(generated, whole, before, seed)
    if places is None:
        strangers = foreign(some, generated if before is None else np.concatenate([before, generated])[:EXAMINED])
    else:
        strangers = strange(*places, seed=seed)
    size = min(len(generated), len(some))
    one, other = np.array_split(read_some, 2)
    figures = Figures(
        joint=joint,
        single=single,
        difference=difference_test(generated, whole, resolution, seed),
        names=names,
        from_prior=from_prior,
        p_value=permutation_p(generated, whole, seed=seed),
        real_unmatched=_measured(~to_generated.like, to_generated.nearest, floor, which),
        real_out_of_support=_measured(nowhere, nearest, floor, which),
        generated_unmatched=_measured(~to_real.like, to_real.nearest, floor, np.arange(len(generated))),
        modes=found,
        foreign=float(strangers.mean()),
        by_appearance=places is not None,
        effective=effective_share(read_generated, read_some, seed=seed),
        effective_floor=effective_share(one, other, seed=seed),
        fidelity=fidelity(generated[:size], some[:size]),
        fidelity_floor=fidelity(first, second),
        numbers=(len(generated), len(whole), 0 if before is None else len(before)),
    )
    explained = nowhere.sum() > 0 and len(some) - nowhere.sum() >= NEEDED
    if explained:
        rest = (
            energy_test(generated, some[~nowhere], seed=seed),
            marginals(read_generated, read_some[~nowhere], seed=seed),
        )
        explained = _halved(rest[0], joint) and _halved(rest[1].largest, single.largest)
    verdict, because = decide(figures, explained)
    return Trust(verdict, because, figures, pretrained)


def _read(features: Features, resolution: float, rng: np.random.Generator) -> Features:
    """With the error that a judge reads them with: what is smaller cannot be told."""
    return features + resolution * rng.standard_normal(features.shape)


def _halved(rest: EnergyTest, whole: EnergyTest) -> bool:
    """Whether what is more than chance of a distance is less than half of what it was."""
    excess = [max(0.0, each.distance**2 - each.floor**2) for each in (rest, whole)]
    return rest.close or 4 * excess[0] < excess[1]


def _scenes(features: ArrayLike, width: int, what: str) -> Features:
    features = np.asarray(features, np.float64)
    if features.ndim != 2 or features.shape[1] != width or len(features) < NEEDED:
        raise ProbsceneError(
            f"expected {what} features ({NEEDED} or more, {width}), got {features.shape}; sample more scenes with "
            "the network that embedded the real images."
        )
    if not np.isfinite(features).all():
        raise ProbsceneError(f"expected finite {what} features, got NaN or infinity; train the network again.")
    return features


def _measured(unlike: Mask, nearest: Features, floor: float, index: NDArray[np.int64]) -> Gap:
    low, high = interval(np.array([unlike.sum()]), len(unlike), 0.95)
    worst = index[np.argsort(-nearest, kind="stable")[:SHOWN]]
    return Gap(float(unlike.mean()), float(low[0]), float(high[0]), floor, worst)


def _difference(figures: Figures) -> dict[str, Any]:
    found = figures.difference
    return {
        "significant": found.significant,
        "feature": None if found.feature is None else figures.names[found.feature],
        "total_variation": found.total_variation,
        "detectable_total_variation": found.detectable,
        "images": dict(zip(("generated", "real"), found.numbers, strict=True)),
    }


def _apart(found: EnergyTest) -> dict[str, Any]:
    return {**found._asdict(), "ratio": _finite(found.ratio), "close": found.close}


def _gap(found: Gap) -> dict[str, Any]:
    return {**found._asdict(), "worst": found.worst.tolist()}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
