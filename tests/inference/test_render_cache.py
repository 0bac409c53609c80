"""Features of renders that are taken again for scenes of equal counts."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.derive import derive_complete
from probscene.grammar import Grammar
from probscene.inference.divergence import KDELogRatio
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
from probscene.inference.pretrain import pretrain
from probscene.inference.render_cache import RenderCache
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.model import Groups, SceneModel
from probscene.sampling import run_program, sample, seed_everything
from probscene.structure import StructurePrior, counts


class Observe:
    """Counts with noise, as of an image; remembers how many scenes it saw."""

    def __init__(self, model, noise=0.1):
        self.model, self.noise, self.seen = model, noise, 0

    def __call__(self, scenes):
        self.seen += len(scenes.derivation)
        assert len(scenes.drawing) == len(scenes.log_prob) == len(scenes.derivation)
        number = scenes.derivation.counts(len(self.model.grammar.kinds)).float()
        return number + self.noise * torch.randn_like(number)


@given(st.integers(0, 10_000), st.integers(1, 4))
@settings(deadline=None, max_examples=20)
def test_features_are_of_a_scene_of_equal_counts_and_as_few_as_asked_are_rendered(dots, seed, least):
    seed_everything(seed)
    observe, cache, drawn = Observe(dots, noise=0.01), RenderCache(dots, least), {}
    features = cache.wrap(observe)
    for number in (7, 30, 1, 60):
        scenes = sample(dots, dots.prior, number)
        each = scenes.derivation.counts(2)
        before = {tuple(row): drawn.get(tuple(row), 0) for row in each.tolist()}
        was = observe.seen
        found = features(scenes)
        assert torch.equal(found.round().long(), each)
        for row in each.tolist():
            if before[tuple(row)] < least:
                drawn[tuple(row)] = drawn.get(tuple(row), 0) + 1
        assert observe.seen - was == sum(before[tuple(row)] < least for row in each.tolist())
    assert cache.rendered == observe.seen == sum(drawn.values()) and cache.requested == 98


def test_which_render_is_taken_again_is_chance(dots):
    seed_everything(0)
    cache = RenderCache(dots, 5)
    features = cache.wrap(Observe(dots, noise=1e-3))
    derivation, _ = derive_complete(dots.grammar, dots.prior, 1, dots.max_steps)
    several = run_program(dots, derivation[torch.zeros(5, dtype=torch.int64)])
    first = features(several)
    taken = torch.cat([features(several) for _ in range(200)])
    often = (taken[:, None] == first).all(2).sum(0)
    assert cache.rendered == 5 and often.sum() == 1000 and often.min() > 140


def test_groups_are_told_apart(dots):
    grammar = Grammar("Scene -> Plates\nPlates -> Plate Plates | ε\nPlate -> plate(Dots)\nDots -> dot Dots | ε")
    prior = StructurePrior(grammar, Plates=counts(0, 0, 1, 1), Dots=counts(1, 1, 1))
    model = SceneModel("plates", grammar, prior, dots.program, (64, 64), 30, ("plate", "dot"))
    torch.manual_seed(0)
    derivation, _ = derive_complete(grammar, prior, 200, 30)
    grouped = replace(model, groups=Groups("plate", max_groups=2))
    on = []
    for kind, parent in zip(derivation.kind.tolist(), derivation.parent.tolist(), strict=True):
        plates = [i for i, k in enumerate(kind) if k == 0]
        each = [sum(k == 1 and p == plate for k, p in zip(kind, parent, strict=True)) for plate in plates]
        on.append((len(plates), sum(each), each[0], sum(each[1:])))  # those after the last group count with it
    table = RenderCache(grouped, 1)._counts_of(derivation)
    for i in range(200):
        for j in range(i):
            assert torch.equal(table[i], table[j]) == (on[i] == on[j])
    whole = RenderCache(model, 1)._counts_of(derivation)
    assert len(whole.unique(dim=0)) == len({row[:2] for row in on}) < len(table.unique(dim=0))


def trainer(dots, cache, batches):
    torch.manual_seed(0)
    guide = LSTMGuide(dots.grammar, dots.max_steps, hidden=8)
    pretrain(guide, dots.prior, num_derivations=300, epochs=2, learning_rate=5e-3)
    observe = Observe(dots)
    objective = ScoreFunction(observe if cache is None else cache.wrap(observe), KDELogRatio())
    return observe, StructureTraining(
        dots,
        guide,
        objective,
        torch.full((50, 2), 2.0),
        StructureSchedule(batches=batches, num_scenes=40),
        render_cache=cache,
    )


def test_an_interrupted_training_goes_on_to_the_same_bytes(dots):
    _, whole = trainer(dots, RenderCache(dots, 2), 6)
    whole.run()
    _, part = trainer(dots, RenderCache(dots, 2), 6)

    def interrupt(training, told):
        if training.done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        part.run(interrupt)
    state = {key: value.clone() for key, value in part.state().items()}
    _, rest = trainer(dots, RenderCache(dots, 2), 6)
    rest.restore(state)
    rest.run()
    for key, value in whole.state().items():
        assert torch.equal(value, rest.state()[key]), key
    assert rest.diagnostics()["rendered"] < rest.diagnostics()["of"] == 240


def test_a_pool_that_never_takes_again_changes_nothing(dots):
    _, plain = trainer(dots, None, 3)
    observe, pooled = trainer(dots, RenderCache(dots, 10**9), 3)
    plain.run()
    pooled.run()
    assert observe.seen == 120
    for key, value in plain.guide.state_dict().items():
        assert torch.equal(value, pooled.guide.state_dict()[key])


def test_learning_ends_as_near_with_a_tenth_of_the_renders(dots):
    def mean_reds(cache):
        torch.manual_seed(0)
        guide = LSTMGuide(dots.grammar, dots.max_steps, hidden=16)
        pretrain(guide, dots.prior, num_derivations=1000, epochs=3, learning_rate=5e-3)
        observe = Observe(dots)
        objective = ScoreFunction(
            cache.wrap(observe) if cache else observe, KDELogRatio(), ScoreFunctionConfig(updates=3)
        )
        real = torch.tensor([[2.0, 1.0]]).repeat(50, 1) + 0.1 * torch.randn(50, 2)
        StructureTraining(
            dots, guide, objective, real, StructureSchedule(batches=40, num_scenes=100), render_cache=cache
        ).run()
        drawn = derive_complete(dots.grammar, guide.eval(), 2000, dots.max_steps)[0].counts(2)
        return drawn.float().mean(0), observe.seen

    (plain, every), (pooled, few) = mean_reds(None), mean_reds(RenderCache(dots, 4))
    assert few < 0.1 * every == 400
    assert pooled.tolist() == pytest.approx([2, 1], abs=0.25) and plain.tolist() == pytest.approx([2, 1], abs=0.25)
