"""The verdict on learnt structure, from features alone, without labels.

The first of these that holds:

- domain shift: more than half of the real images show what no scene shows, wherever it stands (``patch_outliers``).
  Without patches: they are farther from every scene than two random scenes are from one another.
- out of support: significantly more than one real image in twenty is covered by no generated and no prior scene, and
  without these images the energy distance of generated and real features is less than half as large.
- not fitted: generated and real features differ by more than is tolerated (``difference_test``), and generated ones
  are within the noise floor of the prior's.
- out of support: more than half of the real images are covered by no scene.
- mode collapse: clusters of the real images have significantly less than a quarter of their share among the generated
  scenes, and more among the prior's; and they hold more than the generated scenes that no real image covers, which show
  that scenes are somewhere else and not just of fewer kinds.
- underfit: generated and real features differ by more than is tolerated.
- good: none of these, down to the smallest difference that would have been detected.

The limits "half", "a quarter" and "one in twenty" are the resolution of the clusters and of the neighbourhoods
(``modes``, ``domain_shift``). A good verdict is about the features: a network that counts wrongly in real images and
rightly in renders gives a good match of wrong counts. Axis letters: N generated, L real, P prior, D features.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probscene.errors import ProbsceneError

from .difference_test import DifferenceTest, difference_test
from .domain_shift import (
    Fidelity,
    Mask,
    Patches,
    coverage,
    distance_outliers,
    fidelity,
    patch_outliers,
    uncovered_floor,
)
from .energy import (
    MAX_IMAGES,
    MIN_IMAGES,
    EnergyTest,
    Features,
    MarginalTest,
    check_features,
    energy_test,
    marginal_test,
    permutation_p_value,
    principal_components,
)
from .modes import Modes, binomial_interval, ess_fraction, modes

DOMAIN_SHIFT_SHARE = 0.5  # of the real images
MAX_OUTLIER_SHARE = 0.05  # of the real images: less is no verdict
LISTED_OUTLIERS = 16  # images on each side


class Verdict(StrEnum):
    """See the module."""

    GOOD = "good"
    NOT_FITTED = "not fitted yet"
    UNDERFIT = "underfit"
    MODE_COLLAPSE = "mode collapse"
    OUT_OF_SUPPORT = "real images lie outside what the model can make"
    DOMAIN_SHIFT = "domain shift"


class UncoveredShare(NamedTuple):
    """Images of one side that the other side does not cover.

    Attributes:
        share: of the images that were examined.
        low, high: its binomial limits, 95 %.
        floor: the largest such share between two halves of the real images.
        worst: indices of some images, those farthest from the other side first, covered or not.
    """

    share: float
    low: float
    high: float
    floor: float
    worst: NDArray[np.int64]


class StructureStatistics(NamedTuple):
    """What a verdict rests on.

    Attributes:
        joint: energy distance of generated and real features.
        marginal: that of the features one by one.
        difference: whether they differ by more than is tolerated, and which difference would be detected.
        feature_names: of the features, or of their principal components.
        from_prior: energy distance of generated and prior features; None where there is no prior.
        p_value: of the permutation test, by all images.
        real_uncovered: real images that no generated scene covers.
        real_out_of_support: real images that no generated and no prior scene covers.
        generated_uncovered: generated scenes that no real image covers; its floor is the real images' own.
        modes: the clusters.
        domain_shift_share: share of the real images of another domain.
        by_patches: whether that is by features of patches.
        ess_fraction, ess_fraction_floor: ESS / N of the generated scenes, and of one real half as the other's sample.
        fidelity, fidelity_floor: precision, recall, density, coverage, and those between real halves.
        sample_sizes: generated, real and prior images.
    """

    joint: EnergyTest
    marginal: MarginalTest
    difference: DifferenceTest
    feature_names: tuple[str, ...]
    from_prior: EnergyTest | None
    p_value: float
    real_uncovered: UncoveredShare
    real_out_of_support: UncoveredShare
    generated_uncovered: UncoveredShare
    modes: Modes
    domain_shift_share: float
    by_patches: bool
    ess_fraction: float
    ess_fraction_floor: float
    fidelity: Fidelity
    fidelity_floor: Fidelity
    sample_sizes: tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class StructureVerdict:
    """A verdict and what it rests on.

    Attributes:
        verdict: the first that holds.
        statistics: all of them.
        outliers_explain: whether most of the distance comes from the real images that are out of support.
    """

    verdict: Verdict
    statistics: StructureStatistics
    outliers_explain: bool

    def record(self) -> dict[str, Any]:
        """For JSON."""
        x = self.statistics
        return {
            "verdict": str(self.verdict),
            "difference": {
                "significant": x.difference.significant,
                "feature": None if x.difference.feature is None else x.feature_names[x.difference.feature],
                "total_variation": x.difference.total_variation,
                "detectable_total_variation": x.difference.detectable,
                "images": dict(zip(("generated", "real"), x.difference.sample_sizes, strict=True)),
            },
            "images": dict(zip(("generated", "real", "prior"), x.sample_sizes, strict=True)),
            "distance": _energy_record(x.joint),
            "largest_single_feature": {
                "name": x.feature_names[x.marginal.feature],
                **_energy_record(x.marginal.largest),
            },
            "single_features": dict(zip(x.feature_names, x.marginal.distances.tolist(), strict=True)),
            "distance_from_prior": None if x.from_prior is None else _energy_record(x.from_prior),
            "p_value": x.p_value,
            "unlike": _uncovered_record(x.real_uncovered),
            "outside": _uncovered_record(x.real_out_of_support),
            "strange": _uncovered_record(x.generated_uncovered),
            "modes": [
                {
                    "centre": dict(zip(x.feature_names, x.modes.centre[k].tolist(), strict=True)),
                    "real": float(x.modes.real[k]),
                    "generated": float(x.modes.generated[k]),
                    "prior": _finite(float(x.modes.prior[k])),
                    "ratio": [_finite(float(x.modes.low[k])), _finite(float(x.modes.high[k]))],
                    "lost": bool(x.modes.collapsed[k]),
                    "missing": bool(x.modes.missing[k]),
                }
                for k in np.argsort(-x.modes.real)
            ],
            "foreign": {"share": x.domain_shift_share, "by_appearance": x.by_patches},
            "effective_share": {"generated": x.ess_fraction, "floor": x.ess_fraction_floor},
            **{
                key: {"generated": getattr(x.fidelity, key), "floor": getattr(x.fidelity_floor, key)}
                for key in Fidelity._fields
            },
        }


def structure_verdict(
    generated: ArrayLike,
    real: ArrayLike,
    prior: ArrayLike | None = None,
    names: tuple[str, ...] | None = None,
    resolution: float = 0.0,
    patches: tuple[Patches, Patches] | None = None,
    seed: int = 0,
) -> StructureVerdict:
    """Judge a fit.

    Args:
        generated: ``(N, D)`` features of the guide's scenes; 1,000 and more make a narrower verdict.
        real: ``(L, D)`` of the target's images.
        prior: ``(P, D)`` of the scenes that the guide was initialised from.
        names: of the features.
        resolution: features that differ by less mean the same: 0.5 for counts.
        patches: of some real images and of some scenes, to detect a domain shift by; see ``patch_outliers``.
        seed: of the splits.

    Raises:
        DataError: see ``check_features``: fewer real images than are needed, all alike, or not finite.
        ProbsceneError: fewer scenes than are needed, or features of another width.
    """
    real = check_features(real)
    D = real.shape[1]
    scenes = [_check_scenes(generated, D, "generated"), *([] if prior is None else [_check_scenes(prior, D, "prior")])]
    reduced = principal_components([real, *scenes])
    if reduced[0].shape[1] != D or names is None:
        names = tuple(
            f"feature {j}" if reduced[0].shape[1] == D else f"component {j}" for j in range(len(reduced[0].T))
        )
    all_real, generated, before = reduced[0], reduced[1], None if prior is None else reduced[2]
    rng = np.random.default_rng(seed)
    examined = rng.permutation(len(all_real))[: min(len(all_real), len(generated), MAX_IMAGES)]
    real = all_real[examined]
    noisy_generated, noisy_all_real, noisy_real = (
        _with_noise(features, resolution, rng) for features in (generated, all_real, real)
    )
    joint = energy_test(generated, all_real, seed=seed)
    marginal = marginal_test(noisy_generated, noisy_all_real, seed=seed)
    by_generated = coverage(real, generated, resolution=resolution)
    out_of_support, nearest = ~by_generated.covered, by_generated.nearest
    if before is not None:
        by_prior = coverage(real, before, resolution=resolution)
        out_of_support, nearest = out_of_support & ~by_prior.covered, np.minimum(nearest, by_prior.nearest)
    by_real = coverage(generated, real, resolution=resolution)
    floor = uncovered_floor(real, resolution=resolution, seed=seed)
    if patches is None:
        scenes = generated if before is None else np.concatenate([before, generated])[:MAX_IMAGES]
        outliers = distance_outliers(real, scenes)
    else:
        outliers = patch_outliers(*patches, seed=seed)
    size, half = min(len(generated), len(real)), len(real) // 2
    halves = np.array_split(noisy_real, 2)
    statistics = StructureStatistics(
        joint=joint,
        marginal=marginal,
        difference=difference_test(generated, all_real, resolution, seed),
        feature_names=names,
        from_prior=None if before is None else energy_test(generated, before, seed=seed),
        p_value=permutation_p_value(generated, all_real, seed=seed),
        real_uncovered=_uncovered(~by_generated.covered, by_generated.nearest, floor, examined),
        real_out_of_support=_uncovered(out_of_support, nearest, floor, examined),
        generated_uncovered=_uncovered(~by_real.covered, by_real.nearest, floor, np.arange(len(generated))),
        modes=modes(generated, all_real, before, seed),
        domain_shift_share=float(outliers.mean()),
        by_patches=patches is not None,
        ess_fraction=ess_fraction(noisy_generated, noisy_real, seed=seed),
        ess_fraction_floor=ess_fraction(halves[0], halves[1], seed=seed),
        fidelity=fidelity(generated[:size], real[:size]),
        fidelity_floor=fidelity(real[:half], real[half : 2 * half]),
        sample_sizes=(len(generated), len(all_real), 0 if before is None else len(before)),
    )
    explain = bool(out_of_support.any() and (~out_of_support).sum() >= MIN_IMAGES)
    if explain:
        rest = energy_test(generated, real[~out_of_support], seed=seed)
        largest = marginal_test(noisy_generated, noisy_real[~out_of_support], seed=seed).largest
        explain = _halved(rest, joint) and _halved(largest, marginal.largest)
    return StructureVerdict(decide(statistics, explain), statistics, explain)


def decide(found: StructureStatistics, outliers_explain: bool) -> Verdict:
    """The first verdict that holds; see the module."""
    if found.domain_shift_share > DOMAIN_SHIFT_SHARE:
        return Verdict.DOMAIN_SHIFT
    outside, differ = found.real_out_of_support, found.difference.significant
    significant = outside.low > max(MAX_OUTLIER_SHARE, outside.floor)
    if significant and outliers_explain:
        return Verdict.OUT_OF_SUPPORT
    if differ and found.from_prior is not None and found.from_prior.close:
        return Verdict.NOT_FITTED
    collapsed = float(found.modes.real[found.modes.collapsed].sum())
    if significant and outside.share > max(0.5, collapsed):
        return Verdict.OUT_OF_SUPPORT
    if collapsed > max(0.0, found.generated_uncovered.share - found.generated_uncovered.floor):
        return Verdict.MODE_COLLAPSE
    return Verdict.UNDERFIT if differ else Verdict.GOOD


def _with_noise(features: Features, resolution: float, rng: np.random.Generator) -> Features:
    """With the error of measurement, so that smaller differences vanish."""
    return features + resolution * rng.standard_normal(features.shape)


def _halved(rest: EnergyTest, whole: EnergyTest) -> bool:
    """Whether the squared distance above the floor's has fallen to less than a quarter."""
    excess = [max(0.0, each.distance**2 - each.floor**2) for each in (rest, whole)]
    return rest.close or 4 * excess[0] < excess[1]


def _check_scenes(features: ArrayLike, width: int, what: str) -> Features:
    features = np.asarray(features, np.float64)
    if features.ndim != 2 or features.shape[1] != width or len(features) < MIN_IMAGES:
        raise ProbsceneError(
            f"expected {what} features ({MIN_IMAGES} or more, {width}), got {features.shape}; sample more scenes with "
            "the network that embedded the real images."
        )
    if not np.isfinite(features).all():
        raise ProbsceneError(f"expected finite {what} features, got NaN or infinity; train the network again.")
    return features


def _uncovered(uncovered: Mask, nearest: Features, floor: float, index: NDArray[np.int64]) -> UncoveredShare:
    low, high = binomial_interval(np.array([uncovered.sum()]), len(uncovered), 0.95)
    worst = index[np.argsort(-nearest, kind="stable")[:LISTED_OUTLIERS]]
    return UncoveredShare(float(uncovered.mean()), float(low[0]), float(high[0]), floor, worst)


def _energy_record(found: EnergyTest) -> dict[str, Any]:
    known = {"judged" if name == "split_size" else name: value for name, value in found._asdict().items()}
    return known | {"ratio": _finite(found.ratio), "close": found.close}


def _uncovered_record(found: UncoveredShare) -> dict[str, Any]:
    return {**found._asdict(), "worst": found.worst.tolist()}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
