"""Kinds whose number is penalty at the prior's while that of others is learnt."""

import pytest
import torch

from probscene.derive import derive_complete
from probscene.inference.count_penalty import PriorCountPenalty
from probscene.inference.divergence import KDELogRatio
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
from probscene.inference.pretrain import pretrain
from probscene.inference.structure_training import StructureSchedule, StructureTraining


def learnt(dots, penalty, seed=0):
    """Means of red and blue where images show four red ones, and nothing of the blue."""
    torch.manual_seed(seed)
    guide = LSTMGuide(dots.grammar, dots.max_steps, hidden=16)
    pretrain(guide, dots.prior, num_derivations=1000, epochs=3, learning_rate=5e-3)
    red = dots.grammar.kind("red")
    objective = ScoreFunction(
        penalty.append_counts(lambda scenes: scenes.derivation.counts(len(dots.grammar.kinds))[:, [red]].float()),
        penalty.add_to(KDELogRatio()),
        ScoreFunctionConfig(updates=3),
    )
    real = torch.full((50, 1), 2.0) + (torch.rand(50, 1) < 0.3)
    StructureTraining(dots, guide, objective, real, StructureSchedule(batches=40, num_scenes=100), seed=seed).run()
    counts = derive_complete(dots.grammar, guide.eval(), 2000, dots.max_steps)[0].counts(len(dots.grammar.kinds))
    return tuple(float(counts[:, dots.grammar.kind(name)].float().mean()) for name in ("red", "blue"))


def test_held_kinds_keep_their_number_while_others_are_learnt(dots):
    torch.manual_seed(1)
    free, kept = learnt(dots, PriorCountPenalty(dots, (), 100)), learnt(dots, PriorCountPenalty(dots, ("blue",), 100))
    assert abs(free[1] - 1) > 0.3  # the prior's mean is 1
    assert kept[0] == pytest.approx(2.3, abs=0.3)
    assert kept[1] == pytest.approx(1, abs=0.2)


def test_nothing_held_changes_no_cost_and_draws_nothing(dots):
    torch.manual_seed(0)
    penalty = PriorCountPenalty(dots, (), 100)
    assert torch.equal(torch.rand(3), torch.rand(3, generator=torch.Generator().manual_seed(0)))
    generated, real = torch.randn(20, 2), torch.randn(30, 2)
    assert torch.equal(penalty.add_to(KDELogRatio())(generated, real), KDELogRatio()(generated, real))


def test_costs_are_zero_in_the_mean_where_the_numbers_are_the_priors(dots):
    torch.manual_seed(0)
    penalty = PriorCountPenalty(dots, ("red", "blue"), 500)
    drawn, _ = derive_complete(dots.grammar, dots.prior, 500, dots.max_steps)
    counts = drawn.counts(len(dots.grammar.kinds))[:, penalty.kinds] / penalty.bandwidth
    cost = penalty.add_to(lambda generated, real: torch.zeros(len(generated)))(
        torch.cat([torch.zeros(500, 1), counts], 1), torch.zeros(40, 1)
    )
    assert abs(float(cost.mean())) < 0.05
