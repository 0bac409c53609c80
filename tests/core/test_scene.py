"""Scene graphs against plain Python loops."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import poutine

from probscene.derivation import Derivation
from probscene.derive import derive
from probscene.drawing import Atlas, Sprites, disc
from probscene.errors import GrammarError, ModelError
from probscene.grammar import Grammar
from probscene.policy import Policy
from probscene.scene import SceneGraph

N, T = 6, 14
SEED = st.integers(0, 2**31)


def scene_of(policy, seed):
    torch.manual_seed(seed)
    with pyro.plate("scenes", N, dim=-2):
        return SceneGraph(policy.grammar, derive(policy.grammar, policy, N, T))


def nodes(scene, i):
    """Kind name and parent of the nodes of one scene."""
    kinds = [scene.grammar.kinds[k] for k in scene.kind[i].tolist() if k >= 0]
    return list(zip(kinds, scene.parent[i].tolist(), strict=False))


@st.composite
def scenes_and_kinds(draw):
    scene = scene_of(draw(st.from_type(Policy)), draw(SEED))
    kinds = st.lists(st.sampled_from(scene.grammar.kinds), unique=True) if scene.grammar.kinds else st.just([])
    return scene, draw(kinds)


@given(scenes_and_kinds())
def test_mask_rank_and_count_are_what_a_loop_counts(drawn):
    scene, kinds = drawn
    mask, rank, count = scene.mask(*kinds), scene.rank(*kinds), scene.count(*kinds)
    for i in range(N):
        own = nodes(scene, i)
        for m, (kind, parent) in enumerate(own):
            siblings = [j for j, (k, p) in enumerate(own) if p == parent and k in kinds]
            assert mask[i, m] == (kind in kinds)
            assert rank[i, m] == sum(j < m for j in siblings)
            assert count[i, m] == len(siblings)
        assert not mask[i, len(own) :].any()


@given(st.from_type(Policy), SEED)
def test_of_parent_reads_the_parent(policy, seed):
    scene = scene_of(policy, seed)
    value = torch.rand(scene.kind.shape)
    parents = scene.of_parent(value, default=-7.0)
    for i in range(N):
        for m, (_, parent) in enumerate(nodes(scene, i)):
            assert parents[i, m] == (value[i, parent] if parent >= 0 else -7.0)
    assert (scene.of_parent(value)[scene.parent < 0] == 0).all()
    assert (scene.of_parent(3.0)[scene.parent >= 0] == 3).all()


@given(scenes_and_kinds())
def test_sites_on_nodes_count_only_there(drawn):
    scene, kinds = drawn

    def program():
        with pyro.plate("scenes", N, dim=-2):
            with scene.nodes(*kinds):
                pyro.sample("a", dist.Normal(0.0, 1.0))
            with scene.nodes(*scene.grammar.kinds):  # the plate of nodes is entered as often as one likes
                pyro.sample("b", dist.Normal(torch.zeros(3), 1.0).to_event(1))

    trace = poutine.trace(program).get_trace()
    trace.compute_log_prob()
    a, b = trace.nodes["a"], trace.nodes["b"]
    assert a["value"].shape == scene.kind.shape and b["value"].shape == (*scene.kind.shape, 3)
    assert torch.equal(a["log_prob"] != 0, scene.mask(*kinds))
    assert torch.equal(b["log_prob"] != 0, scene.kind >= 0)


ROADS = Grammar("Scene -> sky Roads\nRoads -> Road Roads | ε\nRoad -> road(Cars)\nCars -> car Cars | bus Cars | ε")


def two_roads():
    rules = torch.tensor([[0, 1, 3, 4, 5, 6, 1, 3, 4, 6, 2], [0, 2, *[-1] * 9]])  # a road of car bus, one of car
    return SceneGraph(ROADS, Derivation.from_rules(ROADS, rules))


def test_a_scene_by_hand():
    scene = two_roads()
    assert [ROADS.kinds[k] for k in scene.kind[0].tolist()] == ["sky", "road", "car", "bus", "road", "car"]
    assert scene.parent.tolist() == [[-1, -1, 1, 1, -1, 4], [-1] * 6]
    assert scene.rank("car", "bus")[0].tolist() == [0, 0, 0, 1, 0, 0]
    assert scene.rank("road")[0].tolist() == [0, 0, 0, 0, 1, 0]
    assert scene.count("road")[0].tolist() == [2, 2, 0, 0, 2, 0]
    assert scene.count("car", "bus")[0, 2:].tolist() == [2, 2, 0, 1]


def test_unknown_kinds():
    scene = two_roads()
    with pytest.raises(GrammarError, match="got 'lorry'"):
        scene.mask("lorry")
    with pytest.raises(GrammarError, match="got 'lorry'"), scene.nodes("lorry"):
        pass


def test_draw_gives_each_layer_its_nodes():
    scene = two_roads()
    x = torch.arange(12.0).view(2, 6)
    drawing = scene.draw(
        Sprites.box("road", x, 5.0, 20.0, 4.0), Sprites.disc(("car", "bus"), x, 1.0, radius=2.0), background=(0, 0, 1)
    )
    road, cars = drawing.layers
    assert torch.equal(road.present, scene.mask("road")) and torch.equal(cars.present, scene.mask("car", "bus"))
    assert torch.equal(road.x, x) and (road.y == 5).all() and road.tint.shape == (2, 6, 3)
    assert drawing.kinds == ROADS.kinds and torch.equal(drawing.kind, scene.kind) and drawing.background == (0, 0, 1)
    assert len(drawing) == 2 and torch.equal(drawing[1:].layers[0].x, x[1:])


def test_draw_looks_only_at_its_own_nodes():
    scene = two_roads()
    x = torch.full((2, 6), torch.nan).where(~scene.mask("car"), 1.0)
    scene.draw(Sprites.disc("car", x, 1.0, radius=2.0))
    with pytest.raises(ModelError, match="finite"):
        scene.draw(Sprites.disc("bus", x, 1.0, radius=2.0))
    with pytest.raises(ModelError, match="broadcast"):
        scene.draw(Sprites.disc("car", torch.zeros(2, 5), 1.0, radius=2.0))


def test_a_layer_draws_fewer_of_its_nodes_where_present_says_so():
    scene = two_roads()
    even = torch.arange(6).expand(2, 6) % 2 == 0
    (layer,) = scene.draw(Sprites.disc(("car", "bus"), 1.0, 1.0, radius=2.0), background=(0, 0, 0)).layers[:1]
    (fewer,) = scene.draw(Sprites(("car", "bus"), layer.atlas, 0, 1.0, 1.0, present=even)).layers
    assert torch.equal(fewer.present, layer.present & even)


def test_decoration_belongs_to_no_node_and_has_no_label():
    scene = two_roads()
    there = torch.tensor([[True, False, True], [False, False, True]])
    x = torch.tensor([[1.0, torch.nan, 3.0], [torch.nan, torch.nan, 6.0]])
    (layer,) = scene.draw(Sprites((), Atlas((disc(4),)), 0, x, 2.0, present=there)).layers
    assert torch.equal(layer.present, there) and not layer.labelled and layer.y.shape == (2, 3)
    for wrong in (None, there[:1], there.float(), there[0]):
        with pytest.raises(ModelError, match=r"present, bool \(2 scenes, how many\)"):
            scene.draw(Sprites((), Atlas((disc(4),)), 0, 1.0, 2.0, present=wrong))
