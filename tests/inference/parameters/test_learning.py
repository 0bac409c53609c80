"""Parameters learnt from values, and from images."""

import copy
from functools import partial

import pytest
import torch
from scipy.stats import kstest
from torch.distributions import Categorical

from probscene.inference.features.base import class_table, examples
from probscene.inference.features.counting.net import CountNet
from probscene.inference.parameters import learning as of_images
from probscene.inference.parameters import missed_objects as missing
from probscene.inference.parameters import reader
from probscene.inference.parameters.backbone import RenderBackbone
from probscene.inference.parameters.calibration import CalibratedReader
from probscene.inference.parameters.checkpoint_selection import HeldOutSet
from probscene.inference.parameters.graph import SceneGraph
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.learning import ParameterLearning
from probscene.inference.parameters.likelihood import MaximumLikelihood, Values, draws_and_density, log_density
from probscene.inference.parameters.net import ParameterNet
from probscene.inference.parameters.schedule import LIKELIHOOD, REFIT, SCENES, WEIGHTS, ParameterSchedule
from probscene.inference.parameters.skill import Skill
from probscene.renderers.sprites import SpriteRenderer


@pytest.fixture(autouse=True)
def _few_renders(monkeypatch):
    for name in ("CALIBRATION_RENDERS", "BUILDER_RENDERS", "MISSED_RENDERS"):
        monkeypatch.setattr(of_images, name, 60)


def rows(number=300, sd=0.01, noise=0.0, seed=0):
    """Three siblings each, evenly spaced in the first site, all the same in the second."""
    torch.manual_seed(seed)
    kind, parent = torch.zeros(number, 3, dtype=torch.int64), torch.full((number, 3), -1)
    even = torch.tensor([0.25, 0.5, 0.75]).expand(number, 3)
    both = torch.stack([even, torch.full((number, 3), 0.4)], -1) + noise * torch.randn(number, 3, 2)
    none = torch.zeros(number, 0)
    return Values(kind, parent, both, torch.full_like(both, sd), none, none, torch.zeros(2, dtype=torch.bool))


@torch.no_grad()
def posterior_draws(net, values, candidates):
    return draws_and_density(net, values.sample(), [values.sample() for _ in range(candidates)])[0]


def test_what_was_read_is_learnt():
    torch.manual_seed(0)
    net = ParameterNet(1, 2, 0, hidden=24)
    values = rows()

    def density():
        with torch.no_grad():
            return float(log_density(net, values).sum(1).mean())

    before = density()
    MaximumLikelihood(net, values, steps=200, images=64, learning_rate=1e-2).run()
    assert abs(before) < 3 < 10 < density()
    graph, found = SceneGraph.from_nodes(values.kind, values.parent), torch.full((300, 3, 2), torch.nan)
    with torch.no_grad():
        for s in range(2):
            found[..., s] = net.sample(graph, values.scene, found, s, torch.rand(300, 3), values.kind >= 0)
    assert float((found - values.nodes).abs().mean()) < 0.04


def test_the_error_of_readings_is_taken_out():
    """Values that are all the same, read with an error: a guide of the readings themselves would keep that error."""
    torch.manual_seed(0)
    net, values = ParameterNet(1, 2, 0, hidden=24), rows(600, sd=0.1, noise=0.1)
    MaximumLikelihood(net, values, steps=300, images=100, learning_rate=1e-2).run()
    spread = posterior_draws(net, values, 16).nodes.std(0).mean()
    assert float(values.sample().nodes.std(0).mean()) > 0.13 and float(spread) < 0.085


def test_density_and_draws_are_those_of_one_site_after_the_other():
    """Sites of some nodes each; a slow twin asks for each mixture anew, of all nodes and one candidate at a time."""
    torch.manual_seed(0)
    net, kind = ParameterNet(2, 5, 1, hidden=8), torch.randint(0, 2, (30, 6)).sort(1).values
    for part in net.parameters():
        torch.nn.init.normal_(part, 0, 0.4)
    has = torch.stack([kind == 0, kind == 0, kind == 1, kind >= 0, kind >= 0], -1)
    mean = torch.rand(30, 6, 5).where(has, torch.nan)
    sds = torch.full((30, 6, 5), 0.2), torch.full((30, 1), 0.2)
    values = Values(kind, torch.full_like(kind, -1), mean, sds[0], torch.rand(30, 1), sds[1], torch.zeros(6) > 0)
    graph = SceneGraph.from_nodes(kind, values.parent)

    def taken(candidates, log_weight):
        return candidates.gather(-1, Categorical(logits=log_weight).sample().unsqueeze(-1)).squeeze(-1)

    torch.manual_seed(1)
    drawn, others = values.sample(), [values.sample() for _ in range(4)]
    scene, nodes, density = drawn.scene.clone(), drawn.nodes.clone(), []
    with torch.no_grad():
        each = [other.scene[:, 0] for other in others]
        of_scene = net.scene_mixture(graph, scene, 0)
        scene[:, 0] = taken(torch.stack(each, -1), torch.cat([of_scene.log_prob(u[:, None]) for u in each], -1))
        for s in range(5):
            each, mixture = [other.nodes[..., s] for other in others], net.node_mixture(graph, scene, nodes, s)
            nodes[..., s] = taken(
                torch.stack(each, -1), torch.stack([mixture.log_prob(u.nan_to_num(0.5)) for u in each], -1)
            )
            found = net.node_mixture(graph, scene, nodes, s).log_prob(nodes[..., s].nan_to_num(0.5))
            density.append(found.where(has[..., s], 0.0).sum(1))
        density.append(of_scene.log_prob(scene)[:, 0])
        torch.manual_seed(1)
        again = posterior_draws(net, values, 4)
        assert torch.equal(again.scene, scene) and torch.equal(again.nodes.nan_to_num(-1), nodes.nan_to_num(-1))
        assert torch.allclose(log_density(net, again), torch.stack(density, 1), atol=1e-4)


def test_a_node_that_counts_double_is_as_good_as_two():
    net, values = ParameterNet(1, 2, 0, hidden=8), rows(5, noise=0.1)
    torch.nn.init.normal_(net.out[0].weight)
    weight = torch.tensor([0.0, 1.0, 3.0]).expand(5, 3)
    with torch.no_grad():
        found = log_density(net, values._replace(weight=weight))
        each = [log_density(net, values._replace(weight=1.0 * (torch.arange(3) == m).expand(5, 3))) for m in range(3)]
        assert torch.allclose(log_density(net, values), sum(each), atol=1e-4)
    assert torch.allclose(found, each[1] + 3 * each[2], atol=1e-4)
    rows_of = torch.tensor([3, 1])
    assert torch.equal(
        values._replace(weight=weight * torch.arange(5)[:, None]).select(rows_of).weight[:, 1], rows_of.float()
    )


def test_learning_goes_on_to_the_same_bits():
    def learnt():
        torch.manual_seed(0)
        net = ParameterNet(1, 2, 0, hidden=8)
        return MaximumLikelihood(net, rows(40), steps=30, images=20, seed=3)

    class Interrupted(Exception):
        pass

    def interrupt(training, _):
        if training.done == 20:
            raise Interrupted

    whole, first, second = learnt(), learnt(), learnt()
    whole.run()
    with pytest.raises(Interrupted):
        first.run(interrupt)
    second.restore({key: value.clone() for key, value in first.state().items()})
    second.run()
    for one, other in zip(whole.net.parameters(), second.net.parameters(), strict=True):
        assert torch.equal(one, other)


def test_one_layout_in_all_images_is_learnt_as_such():
    torch.manual_seed(0)
    net, values = ParameterNet(1, 2, 0, hidden=8), rows(60, sd=1e-6)
    MaximumLikelihood(net, values, steps=120, images=60, learning_rate=2e-2).run()
    again = posterior_draws(net, values, 4).nodes
    assert torch.isfinite(again).all() and float((again - values.nodes).abs().max()) < 1e-4


def test_few_objects_in_the_target_keep_the_prior(trays, monkeypatch):
    """Nothing is learnt of a site that was hardly read, and it is said."""
    monkeypatch.setattr(reader, "SCORE_THRESHOLDS", (10.0,))  # no object is found
    counts = CountNet(trays.classes, 3, trays.canvas, width=(4, 8, 8))
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    schedule = ParameterSchedule(reader_steps=1, scene_renders=200, steps=2, rounds=0, energy_steps=0, reader_images=2)
    empty = torch.zeros(30, 3, 64, 64, dtype=torch.uint8)
    learning = ParameterLearning(trays, trays.prior, RenderBackbone(counts), label, lambda: empty, schedule)
    learning.run()
    assert learning.calibrated.skill is not None
    learning.calibrated.skill = learning.calibrated.skill._replace(
        share=torch.ones_like(learning.calibrated.skill.share)
    )
    site = next(site for site in learning.sites if site.name == "ball.away")
    assert [site.name for site in learning.learnt] == ["scene.bright", "floor.turn"]
    assert learning.calibrated.why_not(site) == "it was read 0 times in the target, of 20 that it takes"


def test_of_a_site_of_scenes_a_reader_is_told_the_priors_values_alone(trays, monkeypatch):
    """Whatever the guide draws, else it would guess toward that; and it sees scenes that the guide draws."""
    monkeypatch.setattr(Skill, "readable", property(lambda skill: ~skill.share.isnan()))
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    schedule = ParameterSchedule(
        reader_steps=1, scene_renders=200, steps=1, rounds=0, energy_steps=0, weighted_scenes=0, reader_images=2
    )
    counts, images = CountNet(trays.classes, 3, trays.canvas, width=(4, 8, 8)), torch.zeros(30, 3, 64, 64).byte()
    learning = ParameterLearning(trays, trays.prior, RenderBackbone(counts), label, lambda: images, schedule)
    learning.run()
    learning.phase = learning.phases.index(SCENES)
    with torch.no_grad():
        for layer in learning.guide.net.scene_out:  # logits of 2, hardly spread
            layer.weight.zero_()
            layer.bias.copy_(torch.tensor([0.0, 2.0, -4.0]).repeat_interleave(len(layer.bias) // 3))
    bright = [site.name for site in learning.scene_sites].index("scene.bright")
    own, guide_scenes = [], learning.guide_scenes

    def seen(kept, num):
        valued = guide_scenes(kept, num)
        own.append(valued.overall[:, bright])
        return valued

    monkeypatch.setattr(learning, "guide_scenes", seen)
    told = torch.cat([learning._draw_entering(200)[1][:, bright] for _ in range(6)])
    as_drawn = torch.cat(own)
    is_told = ~told.isnan()
    assert kstest(told[is_told].double().numpy(), "uniform").pvalue > 1e-3
    assert len(as_drawn) == 6 * 130 and 0 < int((~is_told).sum()) < len(as_drawn)
    by_guide = (as_drawn - torch.tensor(2.0).sigmoid()).abs() < 0.03
    assert int(by_guide.sum()) >= int((~is_told).sum())


def test_unclear_sites_of_scenes_are_read_anew_by_a_network_that_is_told_them_alone(trays, monkeypatch):
    monkeypatch.setattr(Skill, "readable", property(lambda skill: ~skill.share.isnan()))
    monkeypatch.setattr(CalibratedReader, "low_skill_sites", frozenset(["scene.bright"]))
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    schedule = ParameterSchedule(
        reader_steps=1, scene_renders=200, steps=1, rounds=0, round_steps=1, energy_steps=0, weighted_scenes=4,
        reader_images=2,
    )  # fmt: skip
    counts, images = CountNet(trays.classes, 3, trays.canvas, width=(4, 8, 8)), torch.randint(256, (30, 3, 64, 64))
    learning = ParameterLearning(trays, trays.prior, RenderBackbone(counts), label, images.byte, schedule)
    learning.run()
    anew = torch.tensor([site.name == "scene.bright" for site in learning.scene_sites])
    reader = learning.calibrated.reader
    found, entered = reader.detect(images.byte()), reader.eye.enter(images.byte())
    before, after = reader.overall(entered), reader.again(entered)
    assert not torch.equal(before, after)
    assert torch.equal(found.overall, after.where(anew[:, None], before))
    learning.phase = learning.phases.index(REFIT)
    assert torch.equal(~learning._draw_entering(40)[1].isnan(), anew.expand(40, -1))


def test_trainings_are_judged_by_scenes_as_they_would_come_out(trays, monkeypatch):
    """Sites that would keep their prior have it there, and so have those that are learnt at the end."""
    monkeypatch.setattr(Skill, "readable", property(lambda skill: ~skill.share.isnan()))
    monkeypatch.setattr(CalibratedReader, "low_skill_sites", frozenset(["scene.bright", "ball.away"]))
    monkeypatch.setattr(CalibratedReader, "noisy", property(lambda tried: torch.ones(len(tried.good_sites)).bool()))
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    schedule = ParameterSchedule(
        reader_steps=1, scene_renders=4, steps=1, rounds=1, round_reader_steps=1, round_scene_renders=2,
        round_steps=1, energy_steps=1, energy_scenes=4, weighted_scenes=4, reader_images=2,
    )  # fmt: skip
    counts, images = CountNet(trays.classes, 3, trays.canvas, width=(4, 8, 8)), torch.zeros(30, 3, 64, 64).byte()
    looked, would_keep = [], iter([(), ("floor.turn",), (), ("floor.turn",)])

    def look(guide):
        looked.append(guide.prior_sites)
        return torch.rand(30, 2).double().numpy()

    learning = ParameterLearning(
        trays, trays.prior, RenderBackbone(counts), label, lambda: images, schedule,
        held=HeldOutSet(look, torch.rand(30, 2).double().numpy()), select_prior_sites=lambda _, last: next(would_keep),
    )  # fmt: skip
    learning.run()
    assert looked == [{"scene.bright"}, {"scene.bright", "floor.turn"}, {"scene.bright"}]
    assert learning.prior_sites == {"floor.turn"} and next(would_keep, None) is None


def test_learning_of_images_goes_on_to_the_same_bits(trays, monkeypatch):
    """In the middle of likelihood, which looks at objects that the guide of before was missing; and of the last
    phases, in whose renders some sites have their prior."""
    phases = [LIKELIHOOD, REFIT, WEIGHTS]
    monkeypatch.setattr(reader, "SCORE_THRESHOLDS", (0.1,))  # an untrained reader finds something
    monkeypatch.setattr(Skill, "readable", property(lambda skill: ~skill.share.isnan()))
    monkeypatch.setattr(missing, "MIN_OBJECTS", 1)
    monkeypatch.setattr(missing, "MIN_DISTANCE", 0.0)
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    few = {"scene_renders": 60, "round_scene_renders": 4, "energy_steps": 0, "weighted_scenes": 60}
    few |= {"reader_steps": 1, "steps": 2, "step_images": 20, "rounds": 1, "round_reader_steps": 1}
    schedule = ParameterSchedule(round_steps=30, **few)
    images = torch.randint(256, (30, 3, 64, 64), dtype=torch.uint8)

    def begun():
        torch.manual_seed(0)
        counts = CountNet(trays.classes, 3, trays.canvas, width=(4, 8, 8))
        return ParameterLearning(
            trays, trays.prior, RenderBackbone(counts), label, lambda: images, schedule, select_prior_sites=select
        )

    asked, kept, suited = [], [], ParameterGuide.with_parameters

    def seen(guide, model):
        kept.append(guide.prior_sites)
        return suited(guide, model)

    monkeypatch.setattr(ParameterGuide, "with_parameters", seen)

    def select(learning, last):
        assert last
        kept.clear()
        asked.append(learning.phases[learning.phase])
        return {"scene.bright"}

    states = {}

    def keep(training, _):
        phase = training.phases[training.phase]
        late = training.phase >= training.phases.index(LIKELIHOOD) + 3
        if late and phase in phases and phase not in states:
            assert phase != LIKELIHOOD or (len(training.missed.label) and training.inner.images == 20)
            assert 0 < training.inner.done < training.inner.total
            states[phase] = copy.deepcopy(training.state())

    whole = begun()
    whole.run(keep)
    assert kept and all("scene.bright" in each for each in kept)  # where the rest is learnt
    assert list(states) == phases
    for state in states.values():
        second = begun()
        second.restore(state)
        second.run()
        for one, other in zip(whole.guide.net.parameters(), second.guide.net.parameters(), strict=True):
            assert torch.equal(one, other)
        assert whole.prior_sites == second.prior_sites == {"scene.bright"}
    assert asked == [REFIT] * 2  # of the whole, and of the one that was not so far


def _labels(render, classes, scenes):
    return examples(render(scenes.drawing), classes)
