"""The objective: a score-function estimate of the divergence between generated and real features, for Pyro's ``SVI``.

    svi = SVI(model, guide, ClippedAdam({"lr": 1e-2}), loss=ScoreFunction(observe, KDELogRatio()))
    svi.step(500, real=features)

Structures T come from the guide, parameters from the model's program run on them, and the cost c of a scene from a
divergence between the features of the rendered batch and those of real images [1]. The gradient is

    sum_i (c_i - b_i) grad log q(T_i) / N,

with the exact marginal over latent vectors in log q; parameters keep their prior, so log q(alpha | T) has no gradient.
A derivation longer than T_max is redrawn, so that scenes are samples of q(T) / Z, with Z the probability to end, and
the gradient of their mean cost is E c (grad log q - grad log Z). A baseline that is the mean of the costs, as with
leave-one-out, leaves nothing of grad log Z, for Z E grad log q(T) is grad Z; any other leaves E(c - b) grad log Z.
With those, failed attempts are scored as well, each with the mean of c - b: as there are (1 - Z) / Z of them a scene,
``sum grad log q(failed) / N`` estimates -grad log Z, whatever scenes cost. The paper takes a moving average and leaves
the term out: what it descends is another gradient while the average lags behind the costs.

The probability that a scene takes more than ``reject_threshold`` failed attempts costs ``reject_weight``. How often a
scene failed says nothing of the derivation that was accepted, so a term in its cost would have no gradient, and the
paper's supplement adds it outside the score function, where it has none either. But the gradient of
P(failures >= k) = (1 - Z)^k is ``-k (1 - Z)^(k - 1) Z E grad log q(T)``: all advantages less the same number.

That term hardly moves where nearly all scenes end in time. Half the squared number f = (1 - Z) / Z of failed attempts
per scene is therefore minimised as well (not in the paper), whose gradient is ``-f (1 + f) E grad log q(T)``.

Departures that an argument turns on: ``updates`` takes several steps on one rendered batch with the clipped importance
ratio of [3]; ``baseline="leave_one_out"`` uses the mean of the other scenes' costs [4] instead of the moving average
[1, 2].

References:
    [1] Devaranjan, Kar, Fidler, *Meta-Sim2*, ECCV 2020, section 3.3.
    [2] Williams, *Simple statistical gradient-following algorithms*, Machine Learning 1992.
    [3] Schulman et al., *Proximal policy optimization algorithms*, 2017.
    [4] Kool, van Hoof, Welling, *Buy 4 REINFORCE samples, get a baseline for free!*, 2019.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import pyro
import torch
from pyro.poutine.runtime import am_i_wrapped
from torch import Tensor

from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.errors import ModelError, ProbsceneError
from probscene.policy import Policy
from probscene.sampling import Scenes, run_program

from .divergence import Divergence
from .guides.base import Guide

MAX_LOG_RATIO = 20.0  # nats, of the KL from the prior
GUIDE_ATTRIBUTES = ("grammar", "log_prob", "max_steps")
BASELINES = ("moving_average", "leave_one_out", "none")


class SceneBatch(NamedTuple):
    """The generated scenes that updates are taken on.

    Attributes:
        derivation: structures, N.
        features: ``(N, D)``.
        cost: ``(N,)``.
        advantage: ``(N,)`` cost less baseline, scaled, and what failed attempts cost.
        rejections: mean failed attempts a scene.
        failed: the F derivations of failed attempts, where the baseline asks for their scores; None for none.
        failed_advantage: ``(F,)``.
    """

    derivation: Derivation
    features: Tensor
    cost: Tensor
    advantage: Tensor
    rejections: float
    failed: Derivation | None
    failed_advantage: Tensor


def _check_guide(guide: object) -> None:
    missing = [name for name in GUIDE_ATTRIBUTES if not hasattr(guide, name)]
    if missing:
        raise ModelError(
            f"expected a guide with {', '.join(GUIDE_ATTRIBUTES[:-1])} and {GUIDE_ATTRIBUTES[-1]}, got "
            f"{type(guide).__name__} without {', '.join(missing)}; derive it from "
            "probscene.inference.guides.base.Guide."
        )


@dataclass(frozen=True)
class ScoreFunctionConfig:
    """How a ``ScoreFunction`` makes a gradient of costs.

    Args:
        baseline: ``"moving_average"``, ``"leave_one_out"`` or ``"none"``.
        decay: weight of the new value in the moving average.
        updates: steps taken on one rendered batch.
        clip: the importance ratio of those steps stays within ``1 +- clip``.
        scale: of the cost; under Adam it changes nothing but the weight of failed attempts, which is not scaled.
        reject_weight, reject_threshold: lambda and epsilon of section 3.3.
        incompletion_weight: of half the squared number of failed attempts.
        prior_kl_weight: of the reverse KL from a prior, where there is one.

    Raises:
        ProbsceneError: an unknown baseline, or numbers out of range.
    """

    baseline: str = "leave_one_out"
    decay: float = 0.05
    updates: int = 1
    clip: float = 0.2
    scale: float = 1.0
    reject_weight: float = 1e-2
    reject_threshold: float = 1.0
    incompletion_weight: float = 1.0
    prior_kl_weight: float = 0.0

    def __post_init__(self) -> None:
        if self.baseline not in BASELINES:
            raise ProbsceneError(f"expected a baseline among {', '.join(BASELINES)}, got {self.baseline!r}.")
        if self.updates < 1 or not 0 < self.decay <= 1 or self.clip <= 0:
            raise ProbsceneError(
                "expected updates >= 1, decay in (0, 1] and clip > 0, got "
                f"{self.updates}, {self.decay} and {self.clip}."
            )
        if self.reject_threshold < 0:
            raise ProbsceneError(
                f"expected a reject_threshold of at least 0 failed attempts, got {self.reject_threshold}."
            )


class ScoreFunction:
    """A loss for ``pyro.infer.SVI``: ``loss(model, guide, num_scenes, real=...)``.

    The guide has a ``grammar``, ``max_steps`` and ``log_prob(derivation)``, and is a ``Policy`` of its grammar:
    ``Guide``, or a module of one's own. Without gradients, as in ``SVI.evaluate_loss``, a call draws scenes of its own
    and changes nothing.

    Args:
        observe: features ``(N, D)`` of a batch of ``Scenes``, for example render and embed; no gradient is taken.
        divergence: one cost a scene.
        config: how costs become a gradient.
        prior: a policy; with ``config.prior_kl_weight`` the reverse KL from it, ``log q(T) - log p(T)`` nats, at most
            ``MAX_LOG_RATIO``, is added to the cost of a scene (not in the paper). Without it, whatever images do not
            show drifts freely, such as the number of cars that are hidden behind others.
        strata: ``(N,)`` int64 of a batch of derivations: scenes of one number have a baseline of their own, as where
            several guides learn together, so that the gradient is that of their own mean cost; all have one where None.

    Attributes:
        batch: the last ``SceneBatch``, for logging.
    """

    def __init__(
        self,
        observe: Callable[[Scenes], Tensor],
        divergence: Divergence,
        config: ScoreFunctionConfig = ScoreFunctionConfig(),
        prior: Policy | None = None,
        strata: Callable[[Derivation], Tensor] | None = None,
    ):
        self.observe, self.divergence, self.config = observe, divergence, config
        self.prior, self.strata = prior, strata
        self.averages: dict[int, float] = {}  # moving, by stratum
        self.batch: SceneBatch | None = None
        self._updates_done = 0
        self._real: Tensor | None = None  # that the batch was compared with
        self._old_log_prob: Tensor | None = None  # log q(T) under the guide that drew the batch

    def __call__(self, model: Callable[[int], Any], guide: Guide, num_scenes: int, real: Tensor) -> Tensor:
        """A scalar whose value is the mean cost and whose gradient is the score-function estimate.

        Raises:
            ModelError: the guide lacks something.
        """
        _check_guide(guide)
        if not torch.is_grad_enabled():
            return self._costs(model, guide, num_scenes, real)[2].mean()
        if am_i_wrapped():  # in SVI, which learns the parameters that it sees registered
            pyro.module("guide", guide)
        done = self._updates_done == self.config.updates
        if self.batch is None or done or not self._reusable(self.batch, num_scenes, real):
            self.batch, self._updates_done, self._real = self._draw(model, guide, num_scenes, real), 0, real
        batch = self.batch
        log_prob, advantage = guide.log_prob(batch.derivation), batch.advantage
        if batch.failed is not None:
            log_prob = torch.cat([log_prob, guide.log_prob(batch.failed)])
            advantage = torch.cat([advantage, batch.failed_advantage])
        if self._updates_done == 0:
            self._old_log_prob = log_prob.detach()
        self._updates_done += 1
        assert self._old_log_prob is not None
        ratio = torch.exp(log_prob - self._old_log_prob)
        clipped = ratio.clamp(1 - self.config.clip, 1 + self.config.clip)
        surrogate = torch.maximum(advantage * ratio, advantage * clipped).sum() / num_scenes
        return batch.cost.mean() + surrogate - surrogate.detach()

    def _reusable(self, batch: SceneBatch, num_scenes: int, real: Tensor) -> bool:
        before = self._real
        if len(batch.cost) != num_scenes or (before is None) != (real is None):
            return False
        return before is real or torch.equal(before, real)  # pyright: ignore[reportArgumentType]

    def _costs(
        self,
        model: Callable[[int], Any],
        guide: Guide,
        num_scenes: int,
        real: Tensor,
        failed: list[Derivation] | None = None,
    ) -> tuple[Derivation, Tensor, Tensor, float]:
        """Scenes of the guide, their features and costs, and the mean number of failed attempts; ``failed`` takes
        those."""
        derivation, failures = derive_complete(guide.grammar, guide, num_scenes, guide.max_steps, failed=failed)
        features = self.observe(run_program(model, derivation, failures=failures, density=False))
        cost = self.divergence(features, real)
        if self.prior is not None and self.config.prior_kl_weight:
            log_ratio = guide.log_prob(derivation) - self.prior.log_prob(derivation)
            cost = cost + self.config.prior_kl_weight * log_ratio.clamp(max=MAX_LOG_RATIO)
        return derivation, features, cost, failures.float().mean().item()

    def _draw(self, model: Callable[[int], Any], guide: Guide, num_scenes: int, real: Tensor) -> SceneBatch:
        with torch.no_grad():
            attempts: list[Derivation] | None = None if self.config.baseline == "leave_one_out" else []
            derivation, features, cost, rejections = self._costs(model, guide, num_scenes, real, attempts)
            strata = self._strata(derivation)
            advantage = self.config.scale * (cost - self._baseline(cost, strata))
            failed, failed_advantage = None, advantage[:0]
            if attempts:
                places = torch.arange(sum(map(len, attempts))).split([len(attempt) for attempt in attempts])
                failed = Derivation.merged(guide.grammar, list(zip(places, attempts, strict=True)))
                failed_advantage = _stratum_means(advantage, strata, self._strata(failed))
            advantage = advantage - self._failure_cost(rejections)
            return SceneBatch(derivation, features, cost, advantage, rejections, failed, failed_advantage)

    def _strata(self, derivation: Derivation) -> Tensor:
        return torch.zeros(len(derivation), dtype=torch.int64) if self.strata is None else self.strata(derivation)

    def _failure_cost(self, failed: float) -> float:
        """The cost of a mean number of failed attempts a scene, which is subtracted from all advantages."""
        completion, k = 1 / (1 + failed), math.floor(self.config.reject_threshold) + 1
        rejected = k * (1 - completion) ** (k - 1) * completion
        return self.config.reject_weight * rejected + self.config.incompletion_weight * failed * (1 + failed)

    def _baseline(self, cost: Tensor, strata: Tensor) -> Tensor:
        baseline = torch.zeros_like(cost)
        if self.config.baseline == "none":
            return baseline
        for stratum in strata.unique().tolist():
            own = strata == stratum
            if self.config.baseline == "moving_average":
                baseline[own] = self._moving_average(stratum, cost[own].mean().item())
            else:
                others = cost[own] if own.sum() > 1 else cost  # a scene alone in its stratum has none
                baseline[own] = (others.sum() - cost[own]) / (len(others) - 1)
        return baseline

    def _moving_average(self, stratum: int, new: float) -> float:
        # The paper leaves the first value open. From 0, every scene of the first batches would seem bad, or good.
        before = self.averages.get(stratum)
        self.averages[stratum] = new if before is None else self.config.decay * new + (1 - self.config.decay) * before
        return self.averages[stratum]


def _stratum_means(values: Tensor, strata: Tensor, others: Tensor) -> Tensor:
    """The mean of ``values (N,)`` in each of the strata ``others (F,)``; 0 where there is none."""
    size = 1 + int(torch.maximum(strata.max(), others.max()))
    total = values.new_zeros(size).index_add(0, strata, values)
    return (total / strata.bincount(minlength=size).clamp(min=1))[others]
