"""The objective: what a batch, its baseline and its costs are, and that a guide learns by it."""

import pyro
import pytest
import torch
from pyro.infer import SVI
from pyro.optim import Adam

from probscene.app.fitting.presets import QUICK
from probscene.errors import ModelError, ProbsceneError
from probscene.inference.divergence import JensenShannon, KDELogRatio
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.objective import MAX_LOG_RATIO, ScoreFunction, ScoreFunctionConfig
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.structure import StructurePrior, counts


def test_svi_learns_the_target_distribution(small):
    pyro.set_rng_seed(0)
    guide = LSTMGuide(small.grammar, 4, hidden=16)
    real = small.features[torch.multinomial(small.target, 3000, replacement=True)]
    loss = ScoreFunction(small.observe, KDELogRatio(0.2, None), ScoreFunctionConfig(updates=2))

    def distance():
        return 0.5 * (guide.log_prob(small.derivations).exp() - small.target).abs().sum().item()

    before = distance()
    svi = SVI(small.program, guide, Adam({"lr": 1e-2}), loss=loss)
    for _ in range(240):
        svi.step(300, real=real)
    assert before > 0.3
    assert distance() < 0.1


@pytest.mark.parametrize("objective", ["kde", "js", "witness"])
def test_each_objective_descends_toward_the_target(small, objective):
    """Exactly, summed over every derivation: densities are kernel sums over the enumerated features, the cost is the
    objective's, the gradient the score function's."""
    torch.manual_seed(0)
    guide = LSTMGuide(small.grammar, 4, hidden=16)
    kernel = torch.exp(-0.5 / 0.2 * (small.features.unsqueeze(1) - small.features).square().sum(-1))
    optimiser = torch.optim.Adam(guide.parameters(), lr=1e-2)
    away = []
    for _ in range(400):
        log_q = guide.log_prob(small.derivations)
        q = log_q.detach().exp()
        away.append(0.5 * (q - small.target).abs().sum().item())
        log_ratio = ((kernel @ q) / (kernel @ small.target)).log()
        costs = {
            "kde": log_ratio,
            "js": JensenShannon().cost_of_log_ratio(log_ratio),
            "witness": kernel @ (q - small.target),
        }
        optimiser.zero_grad()
        (q * costs[objective] * log_q).sum().backward()
        optimiser.step()
    assert away[0] > 0.3 and away[-1] < 0.02


@pytest.mark.parametrize("objective", ["kde", "js", "witness"])
def test_each_objective_learns_from_samples(small, objective):
    torch.manual_seed(0)
    guide = LSTMGuide(small.grammar, 4, hidden=16)
    config = QUICK.set("divergence.variance=0.2", "divergence.marginal_variance=none").with_divergence(objective)
    training = config.structure
    loss = ScoreFunction(
        small.observe,
        config.make_divergence(),
        ScoreFunctionConfig(baseline=training.baseline, updates=training.updates),
    )
    real = small.features[torch.multinomial(small.target, 3000, replacement=True)]
    StructureTraining(
        small.program,
        guide,
        loss,
        real,
        StructureSchedule(batches=60, num_scenes=300, learning_rate=training.learning_rate),
    ).run()
    with torch.no_grad():
        assert 0.5 * (guide.log_prob(small.derivations).exp() - small.target).abs().sum().item() < 0.12


def test_value_is_the_mean_cost_and_batches_are_reused(small):
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    seen = []
    loss = ScoreFunction(
        lambda scenes: seen.append(1) or small.observe(scenes), small.cost, ScoreFunctionConfig(updates=3)
    )
    values = [loss(small.program, guide, 50, real=None).item() for _ in range(6)]
    assert len(seen) == 2
    assert values[0] == values[1] == values[2] == pytest.approx(values[0])
    assert values[3] == pytest.approx(loss.batch.cost.mean().item())


def test_moving_average_is_the_papers(small):
    """b <- 0.05 new + 0.95 b, from the first batch's mean."""
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    loss = ScoreFunction(small.observe, small.cost, ScoreFunctionConfig(baseline="moving_average"))
    expected = None
    for _ in range(4):
        loss(small.program, guide, 20, real=None)
        new = loss.batch.cost.mean().item()
        expected = new if expected is None else 0.05 * new + 0.95 * expected
        assert loss.averages == {0: pytest.approx(expected)}
        assert torch.allclose(loss.batch.advantage, loss.batch.cost - expected)


def test_what_an_anchor_never_does_costs_a_bounded_amount(dots):
    loss = ScoreFunction(
        lambda scenes: torch.zeros(len(scenes.failures), 1),
        lambda g, r: torch.zeros(len(g)),
        ScoreFunctionConfig(prior_kl_weight=0.1),
        prior=StructurePrior(dots.grammar, Things=counts(1.0)),
    )
    pyro.set_rng_seed(5)
    loss(dots, LSTMGuide(dots.grammar, 12, hidden=8), 200, real=None)
    something = loss.batch.derivation.lengths > 2
    assert something.any() and (loss.batch.cost[something] == 0.1 * MAX_LOG_RATIO).all()


def test_evaluating_the_loss_changes_nothing(small):
    """Neither the batch, nor how many updates it has left, nor a moving average."""
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    loss = ScoreFunction(small.observe, small.cost, ScoreFunctionConfig(baseline="moving_average", updates=3))
    svi = SVI(small.program, guide, Adam({"lr": 1e-3}), loss=loss)
    first = svi.evaluate_loss(40, real=None)
    assert loss.batch is None and loss.averages == {} and first == pytest.approx(2.0, abs=1.5)
    drawn = []
    for _ in range(6):
        svi.step(40, real=None)
        drawn.append(loss.batch)
        averages = dict(loss.averages)
        svi.evaluate_loss(25, real=None)
        assert loss.batch is drawn[-1] and loss.averages == averages
    assert [batch is drawn[0] for batch in drawn] == [True] * 3 + [False] * 3


def test_other_arguments_start_another_batch(small):
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    loss = ScoreFunction(small.observe, small.cost, ScoreFunctionConfig(updates=5))
    real = small.features, small.features + 1
    drawn = []
    for num, given in ((30, real[0]), (30, real[0].clone()), (20, real[0]), (20, real[1]), (20, real[1])):
        loss(small.program, guide, num, real=given)
        drawn.append(loss.batch)
    assert [len(batch.cost) for batch in drawn] == [30, 30, 20, 20, 20]
    assert drawn[0] is drawn[1] and drawn[3] is drawn[4]
    assert len({id(batch) for batch in drawn}) == 3


def test_a_guide_that_is_none_is_told_what_is_missing(small):
    loss = ScoreFunction(small.observe, small.cost)
    with pytest.raises(ModelError, match="log_prob and max_steps, got StructurePrior without max_steps"):
        loss(small.program, StructurePrior(small.grammar), 20, real=None)
    with pytest.raises(ModelError, match="got function without grammar, log_prob, max_steps"):
        loss(small.program, lambda num_scenes: None, 20, real=None)


def test_bad_arguments_are_named():
    for arguments in (
        {"baseline": "median"},
        {"updates": 0},
        {"decay": 0.0},
        {"clip": -1.0},
        {"reject_threshold": -1},
    ):
        with pytest.raises(ProbsceneError, match="expected"):
            ScoreFunctionConfig(**arguments)
