import pytest
import torch

from probscene.derive import derive_complete
from probscene.errors import ProbsceneError
from probscene.inference.divergence import KDELogRatio
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
from probscene.inference.pretrain import pretrain
from probscene.inference.structure_training import StructureSchedule, StructureTraining


def learner(small, batches, seed=5, divergence=None, **options):
    torch.manual_seed(seed)
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    loss = ScoreFunction(
        lambda scenes: scenes.derivation.counts(len(small.grammar.kinds)).float(),
        divergence or KDELogRatio(),
        ScoreFunctionConfig(baseline="moving_average", updates=2),
    )
    real = small.features[torch.multinomial(small.target, 200, replacement=True)]
    return StructureTraining(small.program, guide, loss, real, StructureSchedule(batches, 40, **options), seed)


@pytest.mark.parametrize("num_real", [None, 50])
def test_interrupted_goes_on_to_the_same_bits(small, num_real):
    whole = learner(small, 6, num_real=num_real)
    whole.run()
    first = learner(small, 6, num_real=num_real)

    class Interrupted(Exception):
        pass

    def stop(learner, _):
        if learner.done == 4:
            raise Interrupted

    with pytest.raises(Interrupted):
        first.run(stop)
    state = {key: value.clone() for key, value in first.state().items()}
    second = learner(small, 6, num_real=num_real)
    second.restore(state)
    second.run()
    for a, b in zip(whole.guide.parameters(), second.guide.parameters(), strict=True):
        assert torch.equal(a, b)


def test_another_seed_learns_otherwise(small):
    one, other = learner(small, 2, seed=1), learner(small, 2, seed=2)
    one.run()
    other.run()
    assert not torch.equal(one.guide.out.weight, other.guide.out.weight)


def test_a_cost_that_is_not_finite_stops_with_the_guide_intact(small):
    broken = learner(small, 3, divergence=lambda generated, real: torch.full((len(generated),), torch.nan))
    before = [p.detach().clone() for p in broken.guide.parameters()]
    with pytest.raises(ProbsceneError, match="At batch 1 of 3"):
        broken.run()
    for a, b in zip(before, broken.guide.parameters(), strict=True):
        assert torch.equal(a, b)


def test_pretraining_reaches_the_entropy_of_the_prior(dots):
    torch.manual_seed(0)
    guide = LSTMGuide(dots.grammar, dots.max_steps, hidden=16)
    pretrain(guide, dots.prior, num_derivations=2000, epochs=10, learning_rate=5e-3)
    held_out, _ = derive_complete(dots.grammar, dots.prior, 2000, dots.max_steps)
    entropy = -dots.prior.log_prob(held_out).mean().item()
    assert -guide.log_prob(held_out).mean().item() < entropy + 0.1
