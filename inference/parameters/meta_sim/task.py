"""Parameters by a task's score, Meta-Sim's other loss.

A task network is trained on what is generated and scored on a few labelled target images. The score has no gradient by
the parameters. So they are sampled from normal distributions around the graph network's output, and descended is [1, 2]

    -(score - b) log q(logits of u),

with b a moving average of the scores. One score is all that a whole batch of scenes is told by, so that the gradient
has a large variance. Axis letters: N scenes, M nodes.

References:
    [1] Kar et al., *Meta-Sim: Learning to Generate Synthetic Datasets*, ICCV 2019, section 3.
    [2] Williams, *Simple statistical gradient-following algorithms*, Machine Learning 1992.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from probscene.sampling import Scenes

from ...training import TrainingLoop
from .differences import SampledScenes, with_values
from .transform import ParameterTransform

BASELINE_DECAY = 0.8

Score = Callable[[Scenes], float]
"""Trains a task network on scenes and says how well it does on the target, more being better."""


class TaskLearning(TrainingLoop):
    """A ``Training`` of a ``ParameterTransform`` by a score.

    Args:
        guide: the transform, trained in place.
        score: of scenes.
        steps: of Adam; each asks for one score.
        scenes: that a score is of.
        spread: standard deviation around the network's output, in logits of u.
        rate: Adam's.
        seed: of everything random.

    Attributes:
        unit, total, done: see ``Training``.
        baseline: the moving average of the scores; None before the first.
    """

    subject = "the parameters"
    remedy = "look at the task's score"

    def __init__(
        self,
        guide: ParameterTransform,
        score: Score,
        steps: int = 50,
        scenes: int = 200,
        spread: float = 0.3,
        rate: float = 1e-3,
        seed: int = 0,
    ):
        self.optimiser = torch.optim.Adam(guide.net.parameters(), lr=rate)
        super().__init__(guide.net, {"adam": self.optimiser}, steps, seed)
        self.guide, self.score, self.scenes, self.spread = guide, score, scenes, spread
        self.baseline: float | None = None

    def step(self) -> float:
        """See ``TrainingLoop``; the loss is minus the score."""
        guide = self.guide
        drawn = SampledScenes.sample(guide.model, guide.structure, guide.sites, self.scenes)
        means = guide.net(drawn.graph, drawn.of_scene, drawn.of_nodes)
        logits = [mean.detach() + self.spread * torch.randn_like(mean) for mean in means]
        with torch.no_grad():
            scenes = with_values(guide.model, guide.sites, drawn, *(logit.sigmoid() for logit in logits))
        score = float(self.score(scenes))
        baseline = score if self.baseline is None else self.baseline
        log_q = drawn.of_scene.new_zeros(())
        for x, mean, u in zip(logits, means, (drawn.of_scene, drawn.of_nodes), strict=True):
            log_q = log_q - 0.5 * ((x - mean) / self.spread).square().where(~u.isnan(), 0.0).sum()  # and a constant
        self.optimiser.zero_grad()
        (-(score - baseline) * log_q / self.scenes).backward()
        self.optimiser.step()
        self.baseline = BASELINE_DECAY * baseline + (1 - BASELINE_DECAY) * score
        return -score

    def summary(self) -> dict[str, Any]:
        """The moving average of the scores."""
        return {} if self.baseline is None else {"score": self.baseline}

    def state(self) -> dict[str, Tensor]:
        """See ``Training``."""
        baseline = torch.nan if self.baseline is None else self.baseline
        return super().state() | {"number.baseline": torch.tensor(baseline, dtype=torch.float64)}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """See ``Training``."""
        super().restore(tensors)
        baseline = tensors["number.baseline"].item()
        self.baseline = None if baseline != baseline else baseline
