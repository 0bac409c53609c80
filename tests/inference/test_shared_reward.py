"""MMD as one reward of all scenes has a gradient."""

import torch

from probscene.app.fitting.presets import QUICK
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig


def test_a_shared_reward_keeps_a_gradient(small):
    """Under the others' mean as a baseline every advantage would be zero, always; under the moving average from the
    second batch on it is not."""
    mmd = QUICK.with_divergence("mmd")
    loss = ScoreFunction(
        lambda scenes: scenes.derivation.counts(len(small.grammar.kinds)).float(),
        mmd.divergence,
        ScoreFunctionConfig(baseline=mmd.structure.baseline),
    )
    for _ in range(2):
        loss(small.program, LSTMGuide(small.grammar, 4, hidden=8), 50, real=small.features[:1] + torch.randn(30, 1))
    assert loss.batch.advantage.abs().min() > 0
