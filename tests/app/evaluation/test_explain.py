"""The sentences of a verdict: each has the figures that decided, and says nothing that does not hold."""

import numpy as np
import pytest

from probscene.app.evaluation.explain import structure_reason
from probscene.inference.statistics.verdict import Verdict, structure_verdict


def sample(seed, number=200, shift=0.0, stretched=1.0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(number, 3)) + [shift, 0, 0]) * [1, stretched, 1]


def patches(seed, shift=0.0):
    found = np.random.default_rng(seed).normal(size=(60, 9, 50)) * 0.1 + np.eye(50)[:9]
    found[:, 1:] += shift
    return found


CASES = {
    Verdict.GOOD: (sample(0), sample(1), sample(2, shift=3)),
    Verdict.NOT_FITTED: (sample(0, shift=1), sample(1), sample(2, shift=1)),
    Verdict.UNDERFIT: (sample(0, shift=1), sample(1), sample(2, shift=3)),
    Verdict.MODE_COLLAPSE: (
        sample(0, 400),
        np.concatenate([sample(1), sample(2, shift=6)]),
        np.concatenate([sample(3), sample(4, shift=6)]),
    ),
    Verdict.OUT_OF_SUPPORT: (sample(0), np.concatenate([sample(1), sample(2, 60, 12)]), sample(3, stretched=2)),
    Verdict.DOMAIN_SHIFT: (sample(0), sample(1, shift=12), sample(2)),
}


@pytest.mark.parametrize("verdict", Verdict)
def test_a_reason_has_the_figures_that_decided(verdict):
    found = structure_verdict(*CASES[verdict], names=("a", "b", "c"))
    assert found.verdict is verdict
    said, x = structure_reason(found), found.statistics
    figure = {
        Verdict.GOOD: f"total variation above {x.difference.detectable:.2f} in any one feature would have been",
        Verdict.NOT_FITTED: "differ significantly, most in all features together (total variation ",
        Verdict.UNDERFIT: f"(total variation {x.difference.total_variation:.2f}).",
        Verdict.MODE_COLLAPSE: f"{x.modes.collapsed.sum()} of {len(x.modes.real)} clusters",
        Verdict.OUT_OF_SUPPORT: f"{100 * x.real_out_of_support.share:.1f} % of the real images are like no generated",
        Verdict.DOMAIN_SHIFT: f"{100 * x.domain_shift_share:.1f} % of the real images have features that are farther",
    }
    assert figure[verdict] in said and said.endswith(".")
    assert ("half as far apart" in said) is (verdict is Verdict.OUT_OF_SUPPORT)


def test_a_domain_shift_by_patches_is_mentioned_from_a_fifth_of_the_images_on():
    near, far, scenes = patches(0), patches(1, 1.0), patches(2)
    for count, verdict, mentioned in (
        (60, Verdict.DOMAIN_SHIFT, 1),
        (20, Verdict.NOT_FITTED, 1),
        (0, Verdict.NOT_FITTED, 0),
    ):
        real = np.concatenate([far[:count], near[count:]])
        found = structure_verdict(*CASES[Verdict.NOT_FITTED], patches=(real, scenes))
        assert found.verdict is verdict
        assert structure_reason(found).count("% of the real images show something that no scene shows") == mentioned
