"""The log density ratio that a fit descends, for 500 generated and 500 real scenes, on one thread.

    python benchmarks/kde_ratio.py

Per number of features D: our joint ratio beside one ``torch.cdist`` of the same sizes, and beside the same ratio from
``scipy.stats.gaussian_kde`` and ``sklearn.neighbors.KernelDensity``, two densities each, as ours. The bandwidth is the
paper's, H = D I, and no scene is left out of its own estimate, as the others cannot. ``apart`` is the largest
difference from theirs, in float64, where ours is in float32. The marginal terms are D ratios of one feature each; their
time is told apart, also beside the plain way, a loop over the features.

The unit is CPU milliseconds of this process; calls take turns, and the fastest of each counts, as other processes
disturb a millisecond easily.
"""

import argparse
import math
import time
from collections.abc import Callable

import numpy as np
import torch
from scipy.stats import gaussian_kde as scipy_kde
from sklearn.neighbors import KernelDensity

from probscene.inference.divergence import KDELogRatio
from probscene.threads import use_threads

SIZES = (2, 10, 64, 512, 2048)


class FixedKDE(scipy_kde):
    """SciPy's with a bandwidth that is given; its own scales the data's covariance, which has no inverse for D > L."""

    def __init__(self, data: np.ndarray, variance: float):
        self.dataset = data.T
        self.d, self.n = self.dataset.shape
        self._weights, self._neff = np.full(self.n, 1 / self.n), self.n
        self.covariance, self.cho_cov = np.eye(self.d) * variance, np.eye(self.d) * math.sqrt(variance)
        self.log_det = self.d * math.log(2 * math.pi * variance)


def scipy_ratio(generated: np.ndarray, real: np.ndarray, variance: float) -> np.ndarray:
    """``(N,)``."""
    log_q, log_p = (FixedKDE(data, variance).logpdf(generated.T) for data in (generated, real))
    return log_q - log_p


def sklearn_ratio(generated: np.ndarray, real: np.ndarray, variance: float) -> np.ndarray:
    """``(N,)``; its tolerances are 0, so it is exact."""
    bandwidth = math.sqrt(variance)
    fitted = (KernelDensity(bandwidth=bandwidth).fit(data) for data in (generated, real))
    log_q, log_p = (kde.score_samples(generated) for kde in fitted)
    return log_q - log_p


def loop_over_features(generated: torch.Tensor, real: torch.Tensor, variance: float) -> torch.Tensor:
    """The sum of the marginal ratios, one feature after the other."""
    single = KDELogRatio(variance, None, leave_one_out=False)
    return sum(single(q, p) for q, p in zip(generated.split(1, 1), real.split(1, 1), strict=True))


def fastest(calls: dict[str, Callable[[], object]], seconds: float) -> dict[str, float]:
    """CPU milliseconds of each, the least of many; they take turns for about ``seconds`` CPU seconds each."""
    best, spent = dict.fromkeys(calls, math.inf), dict.fromkeys(calls, 0.0)
    while min(spent.values()) < seconds:
        for name, call in calls.items():
            if spent[name] > 3 * seconds:
                continue
            start = time.process_time()
            call()
            passed = time.process_time() - start
            best[name], spent[name] = min(best[name], passed), spent[name] + passed
    return {name: 1e3 * passed for name, passed in best.items()}


def row(N: int, D: int, seconds: float) -> str:
    """One line of the table."""
    generated, real = torch.randn(N, D), torch.randn(N, D) * 1.1 + 0.1
    theirs, variance = (generated.double().numpy(), real.double().numpy()), float(D)
    joint = KDELogRatio(variance, None, leave_one_out=False)
    both = KDELogRatio(variance, 0.1, leave_one_out=False)
    ms = fastest({"cdist": lambda: torch.cdist(generated, real), "ours": lambda: joint(generated, real)}, seconds)
    others = {
        "scipy": lambda: scipy_ratio(*theirs, variance),
        "sklearn": lambda: sklearn_ratio(*theirs, variance),
        "both": lambda: both(generated, real),
        "loop": lambda: loop_over_features(generated, real, 0.1),
    }
    ms |= fastest(others, seconds)
    ours = joint(generated, real).double().numpy()
    apart = max(np.abs(ours - other(*theirs, variance)).max() for other in (scipy_ratio, sklearn_ratio))
    marginals = ms["both"] - ms["ours"]
    return (
        f"{D:5} {ms['cdist']:8.2f} {ms['ours']:8.2f} {ms['ours'] / ms['cdist']:7.2f}x {ms['scipy'] / ms['ours']:7.1f}x "
        f"{ms['sklearn'] / ms['ours']:7.1f}x {apart:9.1e} {marginals:12.1f} {marginals / D:10.3f} "
        f"{ms['loop'] / marginals:7.2f}x"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=500, help="generated scenes, and as many real ones")
    parser.add_argument("--seconds", type=float, default=0.5, help="CPU seconds for each cell")
    given = parser.parse_args()
    use_threads(1)
    torch.manual_seed(0)
    print(f"{'D':>5} {'cdist':>8} {'ours':>8} {'/ cdist':>8} {'scipy':>8} {'sklearn':>8} {'apart':>9} ", end="")
    print(f"{'marginals':>12} {'a feature':>10} {'a loop':>8}")
    for D in SIZES:
        print(row(given.scenes, D, given.seconds), flush=True)
    print("Milliseconds. x: how many times as long as ours; under '/ cdist', how many times as long ours is.")


if __name__ == "__main__":
    main()
