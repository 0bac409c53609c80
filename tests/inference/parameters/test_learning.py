"""Parameters learnt from values, and from images."""

import copy
from functools import partial

import pytest
import torch
from scipy.stats import binomtest, kstest, pearsonr

from probscene.inference.features.base import class_table, examples
from probscene.inference.features.counting.net import CountNet
from probscene.inference.parameters import learning as of_images
from probscene.inference.parameters import missed_objects as missing
from probscene.inference.parameters import reader
from probscene.inference.parameters.backbone import RenderBackbone
from probscene.inference.parameters.graph import SceneGraph
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.layout_augmentation import PRIOR_PROBABILITY, SAME, SPACED
from probscene.inference.parameters.learning import ParameterLearning
from probscene.inference.parameters.net import ParameterNet
from probscene.inference.parameters.schedule import LIKELIHOOD, SCENES, ParameterSchedule
from probscene.inference.parameters.sites import find_sites
from probscene.inference.parameters.skill import Skill
from probscene.inference.parameters.stochastic_em import StochasticEM
from probscene.inference.parameters.supervised_renders import SupervisedRenders
from probscene.inference.parameters.values import Values, log_density
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


def test_what_was_read_is_learnt():
    torch.manual_seed(0)
    net = ParameterNet(1, 2, 0, hidden=24)
    values = rows()

    def density():
        with torch.no_grad():
            return float(log_density(net, values).sum(1).mean())

    before = density()
    StochasticEM(net, values, steps=200, images=64, learning_rate=1e-2).run()
    assert abs(before) < 3 < 10 < density()
    graph, found = SceneGraph.from_nodes(values.kind, values.parent), torch.full((300, 3, 2), torch.nan)
    with torch.no_grad():
        for s in range(2):
            found[..., s] = net.sample(graph, values.scene, found, s, torch.rand(300, 3), values.kind >= 0)
    assert float((found - values.nodes).abs().mean()) < 0.04


def test_density_is_that_of_one_site_after_the_other():
    """Sites of some nodes each; a slow twin asks for each mixture anew, of all nodes."""
    torch.manual_seed(0)
    net, kind = ParameterNet(2, 5, 1, hidden=8), torch.randint(0, 2, (30, 6)).sort(1).values
    for part in net.parameters():
        torch.nn.init.normal_(part, 0, 0.4)
    has = torch.stack([kind == 0, kind == 0, kind == 1, kind >= 0, kind >= 0], -1)
    nodes, scene = torch.rand(30, 6, 5).where(has, torch.nan), torch.rand(30, 1)
    sds = torch.full((30, 6, 5), 0.2), torch.full((30, 1), 0.2)
    values = Values(kind, torch.full_like(kind, -1), nodes, sds[0], scene, sds[1], torch.zeros(6) > 0)
    graph, density = SceneGraph.from_nodes(kind, values.parent), []
    with torch.no_grad():
        for s in range(5):
            found = net.node_mixture(graph, scene, nodes, s).log_prob(nodes[..., s].nan_to_num(0.5))
            density.append(found.where(has[..., s], 0.0).sum(1))
        density.append(net.scene_mixture(graph, scene, 0).log_prob(scene)[:, 0])
        assert torch.allclose(log_density(net, values), torch.stack(density, 1), atol=1e-4)


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


def test_few_objects_in_the_target_keep_the_prior(trays, monkeypatch):
    """Nothing is learnt of a site that was hardly read, and it is said."""
    monkeypatch.setattr(reader, "SCORE_THRESHOLDS", (10.0,))  # no object is found
    counts = CountNet(trays.classes, 3, trays.canvas, width=(4, 8, 8))
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    schedule = ParameterSchedule(
        reader_steps=1, scene_renders=200, steps=2, rounds=0, reader_images=2, recalibration_renders=100
    )
    empty = torch.zeros(30, 3, 64, 64, dtype=torch.uint8)
    learning = ParameterLearning(trays, trays.prior, RenderBackbone(counts), label, lambda: empty, schedule)
    learning.run()
    assert learning.calibrated.skill is not None
    learning.calibrated.skill = learning.calibrated.skill._replace(
        explained=torch.ones_like(learning.calibrated.skill.explained)
    )
    site = next(site for site in learning.sites if site.name == "ball.away")
    assert [site.name for site in learning.learnt] == ["scene.bright", "floor.turn"]
    assert learning.calibrated.why_not(site) == "it was read 0 times in the target, fewer than 20"


def test_renders_that_are_drawn_meanwhile_are_those_of_before(trays, monkeypatch):
    """A reader that is interrupted between two draws as well."""
    counts = CountNet(trays.classes, 3, trays.canvas, width=(4, 8, 8))
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    steps = of_images.PREFETCH_STEPS + 3
    schedule = ParameterSchedule(
        reader_steps=steps, scene_renders=1, steps=1, rounds=0, reader_images=2, recalibration_renders=100
    )
    readers = []

    def interrupt(training, report):
        raise KeyboardInterrupt

    for in_turn, is_interrupted in ((True, False), (False, False), (False, True)):
        monkeypatch.setattr(RenderBackbone, "is_random", in_turn)
        torch.manual_seed(0)
        learning = ParameterLearning(trays, trays.prior, RenderBackbone(counts), label, torch.Tensor, schedule)
        if is_interrupted:
            with pytest.raises(KeyboardInterrupt):
                learning._run_phase(interrupt)
            assert 0 < learning.inner.done < steps
        learning._run_phase(None)
        readers.append(learning.calibrated.reader.state_dict())
    for other in readers[1:]:
        assert all(torch.equal(readers[0][key], other[key]) for key in other)


def test_only_draws_of_the_prior_supervise_a_reader_in_the_guides_scenes(trays):
    """Half of the values are such draws: uniform, and nothing else in the scene goes by them. The rest are the guide's:
    the second of two siblings is drawn given the guide's own first one, whatever takes its place."""
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    sites = {site.name: site for site in find_sites(trays)}
    away, bright = sites["ball.away"], sites["scene.bright"]
    renders = SupervisedRenders(trays, label, (sites["tray.x"], away), (bright,))
    torch.manual_seed(0)
    guide = ParameterGuide(trays, (bright, away), trays.prior)
    with torch.no_grad():
        for layer in (*guide.net.out, *guide.net.scene_out):  # logits of 2, hardly spread
            layer.weight.zero_()
            layer.bias.copy_(torch.tensor([0.0, 2.0, -4.0]).repeat_interleave(len(layer.bias) // 3))
    drawn = [renders.draw_mixed(400, guide, 0.5) for _ in range(3)]
    told, at = torch.cat([part.u[..., 1].flatten() for part in drawn]), torch.tensor(2.0).sigmoid()
    balls = sum(int((part.kind >= 0).sum() - (part.kind == trays.grammar.kind("tray")).sum()) for part in drawn)
    told, scene = told[~told.isnan()], torch.cat([part.scene_u[:, 0] for part in drawn])
    scene = scene[~scene.isnan()]
    for some, number in ((told, balls), (scene, 1200)):
        assert kstest(some.double().numpy(), "uniform").pvalue > 1e-6
        assert binomtest(len(some), number).pvalue > 1e-6
        assert float(((some - at).abs() < 0.03).float().mean()) < 0.15
    trays_told = torch.cat([part.u[..., 0][part.kind == trays.grammar.kind("tray")] for part in drawn])
    assert not trays_told.isnan().any()  # not the guide's


def test_only_draws_of_the_prior_have_a_value_in_arranged_scenes(trays):
    """Whatever siblings have; of all the others they tell."""
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    site = {site.name: site for site in find_sites(trays)}["tray.x"]
    torch.manual_seed(0)
    some = SupervisedRenders(trays, label, (site,), ()).draw_augmented(1500, trays.prior, 1.0)
    is_tray = some.kind == trays.grammar.kind("tray")
    two = is_tray.sum(1) == 2
    u = some.u[two][..., 0][is_tray[two]].view(-1, 2)
    told = ~u.isnan()
    share = SAME + SPACED
    assert binomtest(int(told.sum()), told.numel(), 1 - share * (1 - PRIOR_PROBABILITY)).pvalue > 1e-6
    assert kstest(u[told].double().numpy(), "uniform").pvalue > 1e-6
    both = u[told.all(1)].double().numpy()
    assert pearsonr(both[:, 0], both[:, 1]).pvalue > 1e-6


def test_learning_of_images_goes_on_to_the_same_bits(trays, monkeypatch):
    """In the middle of two phases of the second round; likelihood looks at objects that the guide of before was
    missing."""
    phases = [SCENES, LIKELIHOOD]
    monkeypatch.setattr(reader, "SCORE_THRESHOLDS", (0.1,))  # an untrained reader finds something
    monkeypatch.setattr(Skill, "readable", property(lambda skill: ~skill.explained.isnan()))
    monkeypatch.setattr(missing, "MIN_OBJECTS", 1)
    monkeypatch.setattr(missing, "MIN_DISTANCE", 0.0)
    label = partial(_labels, SpriteRenderer(trays.canvas), class_table(trays.grammar.kinds, trays.classes))
    schedule = ParameterSchedule(
        reader_steps=1, scene_renders=60, steps=2, step_images=20, rounds=1, round_reader_steps=1,
        round_scene_renders=60, round_steps=12, reader_images=2, recalibration_renders=100,
    )  # fmt: skip
    images = torch.randint(256, (30, 3, 64, 64), dtype=torch.uint8)

    def begun():
        torch.manual_seed(0)
        counts = CountNet(trays.classes, 3, trays.canvas, width=(4, 8, 8))
        return ParameterLearning(trays, trays.prior, RenderBackbone(counts), label, lambda: images, schedule)

    states = {}

    def keep(training, _):
        phase = training.phases[training.phase]
        late = training.phase >= training.phases.index(LIKELIHOOD) + 1
        if late and phase in phases and phase not in states:
            assert phase != LIKELIHOOD or (len(training.missed.label) and training.inner.images == 20)
            assert 0 < training.inner.done < training.inner.total
            states[phase] = copy.deepcopy(training.state())

    whole = begun()
    whole.run(keep)
    assert list(states) == phases
    for state in states.values():
        second = begun()
        second.restore(state)
        second.run()
        for one, other in zip(whole.guide.net.parameters(), second.guide.net.parameters(), strict=True):
            assert torch.equal(one, other)


def _labels(render, classes, scenes):
    return examples(render(scenes.drawing), classes)
