"""Driving scenes: where everything stands, against plain geometry of its own, and that it renders as a street."""

import math
from itertools import combinations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from probscene.app.loading import load_model, renderer_for
from probscene.models.driving import SCENARIOS, SIMPLE, driving
from probscene.models.streets.grammars import grammar
from probscene.models.streets.layout import STRIPS, in_line
from probscene.models.streets.parameters import PARAMETERS
from probscene.sampling import run_program, sample, seed_everything
from probscene.structure import StructurePrior, counts

TOLERANCE = 0.01  # metres by which rectangles on the ground may overlap
EACH = tuple(SCENARIOS)
ABOVE = 2.0  # metres: what poles and signs have above it may reach over others
CROWDED = {"Cars": 9, "Walk": 15, "Planting": 12, "Buildings": 9, "Foliage": 25}


@pytest.fixture(autouse=True)
def _meshes_of_the_install(monkeypatch):
    monkeypatch.delenv("PROBSCENE_ASSETS", raising=False)


def crowded(scenario):
    """Every list as long as no prior has it."""
    g = grammar(scenario)
    lists = {name: number for name, number in CROWDED.items() if name in g.nonterminals}
    return StructurePrior(g, **{name: counts(*[0] * number, 1) for name, number in lists.items()})


def policies(scenario):
    model = SCENARIOS[scenario]
    return {
        "tuned": model.prior,
        "simple": SIMPLE[scenario].prior,
        "pretraining": model.pretraining,
        "target": model.target(3).prior,
        "crowded": crowded(scenario),
    }


def corners(layer, n, m, low):
    """The rectangle ``(4, 2)`` that a mesh covers on the ground, of what is below a height."""
    points = layer.meshes[int(layer.mesh[n, m])].positions.astype(float)
    points = points[points[:, 2] < low]
    (x0, y0), (x1, y1) = points[:, :2].min(0), points[:, :2].max(0)
    rectangle = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) * layer.scale[n, m, :2].numpy()
    cos, sin = math.cos(layer.yaw[n, m]), math.sin(layer.yaw[n, m])
    return rectangle @ np.array([[cos, sin], [-sin, cos]]) + [float(layer.x[n, m]), float(layer.y[n, m])]


def depth(a, b):
    """How far two rectangles reach into each other, metres; negative if they are apart. Separating axes."""
    least = math.inf
    for rectangle in (a, b):
        for edge in np.diff(rectangle[:3], axis=0):
            axis = np.array([-edge[1], edge[0]]) / np.hypot(*edge)
            p, q = a @ axis, b @ axis
            least = min(least, min(p.max(), q.max()) - max(p.min(), q.min()))
    return least


def standing(model, scenes, n):
    """``{node: (kind, rectangle)}`` of one scene."""
    found = {}
    kinds = scenes.drawing.kinds
    for layer in scenes.drawing.layers:
        if layer.labelled:
            for m in layer.present[n].nonzero().flatten().tolist():
                kind = kinds[int(scenes.derivation.kind[n, m])]
                found[m] = (kind, corners(layer, n, m, ABOVE if kind in ("pole", "sign") else math.inf))
    return found


def strip(scenes, n, name):
    """y of a strip's right and left border."""
    edges, i = scenes.drawing.ground.edges[n], STRIPS.index(name)
    return float(edges[i - 1]), float(edges[i])


@given(
    st.integers(0, 2**31),
    st.sampled_from(EACH),
    st.sampled_from(["tuned", "simple", "pretraining", "target", "crowded"]),
)
@settings(max_examples=20)
def test_everything_stands_where_it_belongs_and_nothing_in_anything_else(seed, scenario, policy):
    model = SCENARIOS[scenario]
    seed_everything(seed)
    scenes = sample(model, policies(scenario)[policy], 2)
    kinds, parent = scenes.drawing.kinds, scenes.derivation.parent
    assert torch.isfinite(scenes.log_prob).all()
    for n in range(2):
        things = standing(model, scenes, n)
        for (_, (_, a)), (_, (_, b)) in combinations(things.items(), 2):
            assert depth(a, b) < TOLERANCE
        own = np.array([[-2.5, -1.1], [4.0, -1.1], [4.0, 1.1], [-2.5, 1.1]])
        assert all(depth(own, rectangle) < 0 for _, rectangle in things.values())
        nodes = scenes.derivation.kind[n].tolist()
        lanes = {kind: [m for m, k in enumerate(nodes) if k == kinds.index(kind)] for kind in ("lane", "oncoming")}
        places = dict(zip(lanes["lane"], ("lane_inner", "lane_outer"), strict=False))
        places |= dict(zip(reversed(lanes["oncoming"]), ("oncoming_inner", "oncoming_outer"), strict=False))
        for m, (kind, rectangle) in things.items():
            above = int(parent[n, m])
            container, y, x = kinds[nodes[above]], rectangle[:, 1], rectangle[:, 0]
            side = "left" if container != "median" and above > nodes.index(kinds.index("left")) else "right"
            if "right" in kinds and above > nodes.index(kinds.index("right")):
                side = "right"
            name = {"sidewalk": f"walk_{side}", "shoulder": f"walk_{side}", "verge": f"verge_{side}"}.get(container)
            if kind == "building":
                low, high = strip(scenes, n, f"verge_{side}")
                assert y.min() > high - TOLERANCE if side == "left" else y.max() < low + TOLERANCE
            else:
                low, high = strip(scenes, n, name or places.get(above, "median"))
                assert low - TOLERANCE < y.min() and y.max() < high + TOLERANCE
            assert x.mean() > 0 and (x.mean() < 100 or kind == "building" or policy in ("crowded", "pretraining"))


@given(st.integers(0, 2**31), st.sampled_from(EACH))
@settings(max_examples=10)
def test_traffic_keeps_to_the_right(seed, scenario):
    seed_everything(seed)
    model = SCENARIOS[scenario]
    scenes = sample(model, model.prior, 8)
    layer, g = scenes.drawing.layers[0], model.grammar
    above = scenes.derivation.kind.gather(1, scenes.derivation.parent.clamp(min=0))
    away = layer.present & (above == g.kind("lane"))
    toward = layer.present & (above == g.kind("oncoming"))
    assert (layer.yaw[away].cos() > 0.999).all() and (layer.yaw[toward].cos() < -0.999).all()
    for n in range(8):
        divider = float(scenes.drawing.ground.edges[n, STRIPS.index("line_right")])
        assert (layer.y[n][away[n]] < divider).all() and (layer.y[n][toward[n]] > divider).all()
        assert abs(float(scenes.drawing.camera.y[n])) < 0.5  # y = 0 is the middle of the camera's lane
        own = [strip(scenes, n, name) for name in ("lane_inner", "lane_outer")]
        assert any(low < -1.4 and high > 1.4 and abs(low + high) < 1e-3 for low, high in own)


@pytest.mark.parametrize("scenario", EACH)
def test_who_stands_on_a_raised_walk_stands_on_top_of_it(scenario):
    seed_everything(1)
    scenes = sample(SCENARIOS[scenario], SCENARIOS[scenario].prior, 40)
    kinds, world = scenes.drawing.kinds, scenes.drawing
    people = scenes.derivation.kind == kinds.index("pedestrian")
    layer = next(x for x in world.layers if x.labelled and torch.equal(x.present, people))
    z = layer.z[people]
    assert z.unique().numel() == 1 and (scenario != "rural") == bool(z[0] > 0.05)
    raised = [
        [float(x.meshes[int(x.mesh[i, j])].size[2] * x.scale[i, j, 2]) for i, j in x.present.nonzero().tolist()]
        for x in world.layers
        if not x.labelled
    ]
    assert any(np.allclose(heights, float(z[0]), atol=1e-4) for heights in raised) == (scenario != "rural")


@given(st.lists(st.tuples(st.floats(0, 1, width=32), st.floats(0.1, 20)), min_size=1, max_size=12), st.floats(5, 100))
def test_a_line_keeps_its_order_its_gaps_and_its_range(things, room):
    place, length = (torch.tensor([column], dtype=torch.float64) for column in zip(*things, strict=True))
    M = len(things)
    x = in_line(
        torch.ones(1, M, M, dtype=torch.bool), place.float(), length.float(), torch.tensor(3.0), torch.tensor(3 + room)
    )
    order = sorted(range(M), key=lambda i: (things[i][0], i))
    low = [float(x[0, i]) - things[i][1] / 2 for i in order]
    high = [float(x[0, i]) + things[i][1] / 2 for i in order]
    assert low[0] > 3 - 1e-3 and all(b > a - 1e-3 for a, b in zip(high, low[1:], strict=False))
    assert high[-1] < max(3 + room, 3 + float(length.sum())) + 1e-3


def test_places_in_a_line_are_uniform_among_those_without_overlap():
    torch.manual_seed(0)
    place = torch.rand(4000, 2)
    x = in_line(
        torch.ones(4000, 2, 2, dtype=torch.bool),
        place,
        torch.full((4000, 2), 4.0),
        torch.tensor(0.0),
        torch.tensor(50.0),
    )
    gap = (x.diff().abs().flatten() - 4) / 42
    assert kstest(gap.numpy(), lambda g: 1 - (1 - g) ** 2).pvalue > 1e-3


@pytest.mark.parametrize("model", [*SCENARIOS.values(), *SIMPLE.values()], ids=lambda model: model.name)
def test_a_seed_gives_the_same_scenes_and_parameters_keep_to_their_ranges(model):
    first, second = [], []
    for found in (first, second):
        seed_everything(5)
        found.append(sample(model, model.prior, 20))
    a, b = first[0], second[0]
    assert torch.equal(a.derivation.rules, b.derivation.rules) and torch.equal(a.log_prob, b.log_prob)
    for one, other in zip(a.drawing.layers, b.drawing.layers, strict=True):
        assert torch.equal(one.x, other.x) and torch.equal(one.tint, other.tint)
    scenario = next(name for name in EACH if name in model.name)
    named = {f"{k}.{n}": r for k, ranges in PARAMETERS[scenario].items() for n, r in ranges.items()}
    assert set(a.parameters) == {key for key in named if key.split(".")[0] in model.grammar.kinds}
    expected = torch.zeros(20)
    for key, value in a.parameters.items():
        low, high = named[key]
        counted = a.site_mask[key]
        assert (value[counted] >= low).all() and (value[counted] <= high).all()
        expected -= counted.sum(1) * math.log(high - low)
    assert torch.allclose(a.log_prob, expected, atol=1e-2, rtol=1e-4)
    again = run_program(model, a.derivation, a.parameters)
    assert torch.equal(again.drawing.layers[0].x, a.drawing.layers[0].x)


@pytest.mark.parametrize("scenario", EACH)
def test_it_renders_as_a_street(scenario):
    model = SCENARIOS[scenario]
    seed_everything(2)
    scenes = sample(model, model.prior, 16)
    batch = renderer_for(model, 1)(scenes.drawing)
    names, semantic = batch.space.names, batch.space.semantic
    height, width = model.canvas
    front = semantic[:, height - 5 :, width // 2 - 30 : width // 2 + 30]
    assert (front == names.index("road")).float().mean() > 0.9
    assert (semantic[:, : height // 8] == names.index("sky")).float().mean() > 0.05
    assert (semantic[:, height - 5 :] != names.index("sky")).all()
    cars = scenes.derivation.kind == model.grammar.kind("car")
    assert ((batch.pixels > 0) & cars).sum() > 0.75 * cars.sum()
    mean = batch.image.float().mean((1, 2, 3))
    assert (mean > 30).all() and (mean < 200).all() and (batch.image.float().std((1, 2, 3)) > 20).all()


def test_a_canvas_of_any_size_sees_the_same_street():
    small, large = driving("city"), driving("city", canvas=(375, 1242))
    seed_everything(3)
    a = sample(small, small.prior, 3)
    b = run_program(large, a.derivation, a.parameters)
    assert torch.allclose(2 * a.drawing.camera.focal, b.drawing.camera.focal)
    assert torch.equal(a.drawing.layers[0].x, b.drawing.layers[0].x)


def test_vans_and_trucks_where_they_are_asked_for():
    model = driving("suburban", vehicles=("car", "van", "truck"))
    assert model.classes[:3] == ("car", "van", "truck")
    policy = StructurePrior(model.grammar, Cars=counts(0, 0, 1))
    seed_everything(4)
    scenes = sample(model, policy, 4)
    for n in range(4):
        for (_, (_, a)), (_, (_, b)) in combinations(standing(model, scenes, n).items(), 2):
            assert depth(a, b) < TOLERANCE


def test_the_scenarios_on_the_command_line():
    assert [name for name, _ in load_model("driving").scenarios] == list(EACH)
    assert load_model("driving:rural") is SCENARIOS["rural"]
    assert load_model("driving_simple:city").name == "driving_city_simple"


@pytest.fixture
def wide_cars(tmp_path, monkeypatch):
    (tmp_path / "car").mkdir()
    box = trimesh.creation.box((6.0, 2.4, 1.5))
    box.export(tmp_path / "car" / "bus.ply")
    monkeypatch.setenv("PROBSCENE_ASSETS", str(tmp_path))


@pytest.mark.usefixtures("wide_cars")
def test_meshes_of_ones_own_decide_how_far_things_stand_apart():
    monkeyed = load_model("driving:suburban")
    seed_everything(6)
    scenes = sample(monkeyed, crowded("suburban"), 2)
    cars = scenes.derivation.kind == monkeyed.grammar.kind("car")
    assert cars.sum() > 10 and (scenes.drawing.layers[0].mesh[cars] == 0).all()
    for n in range(2):
        for (_, (_, a)), (_, (_, b)) in combinations(standing(monkeyed, scenes, n).items(), 2):
            assert depth(a, b) < TOLERANCE
