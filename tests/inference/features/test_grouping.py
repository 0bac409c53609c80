"""Counting by group: votes against a twin that walks over cells, and a network that learns to."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.derivation import Derivation, group_of
from probscene.derive import derive
from probscene.drawing import Sprites
from probscene.errors import ModelError
from probscene.grammar import Grammar
from probscene.inference.features.counting.batches import CountSchedule, object_targets
from probscene.inference.features.counting.grouping import ABSENT, tally_groups
from probscene.inference.features.counting.net import STRIDE, CountNet
from probscene.inference.features.counting.training import CountTraining
from probscene.model import Groups, SceneModel
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts

ROADS = Grammar(
    "Scene -> sky Roads\nRoads -> Road Roads | ε\nRoad -> road(Cars)\nCars -> Car Cars | ε\nCar -> car(dog)"
)


SHELVES = Grammar("Scene -> Shelves\nShelves -> Shelf Shelves | ε\nShelf -> shelf(Discs)\nDiscs -> disc Discs | ε")


def shelves_program(num_scenes, structure):
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(SHELVES, derive(SHELVES, structure, num_scenes, 24))
        with scene.nodes("shelf"):
            shift = pyro.sample("shelf.shift", dist.Uniform(-3.0, 3.0))
        with scene.nodes("disc"):
            side = pyro.sample("disc.side", dist.Uniform(-6.0, 6.0))
    shelf_x = 22 + 42 * scene.rank("shelf") + shift
    disc_x, disc_y = scene.of_parent(shelf_x) + side, 24.0 + 40 * scene.rank("disc")
    return scene.draw(
        Sprites.box("shelf", shelf_x, 64.0, 30.0, 116.0, tint=(0.3, 0.3, 0.7)),
        Sprites.disc("disc", disc_x, disc_y, radius=6.0, tint=(0.9, 0.8, 0.2)),
    )


@pytest.fixture(scope="module")
def shelves():
    """Up to three upright boxes on 128 x 128 pixels, each with up to three discs."""
    prior = StructurePrior(SHELVES, Shelves=counts(0, 1, 1, 1), Discs=counts(1, 1, 1, 1))
    groups = Groups("shelf", along="x", max_groups=3)
    return SceneModel("shelves", SHELVES, prior, shelves_program, (128, 128), 24, ("shelf", "disc"), groups=groups)


def test_a_node_belongs_to_the_nearest_group_above_it():
    rules = torch.tensor([[0, 1, 3, 4, 6, 5, 1, 3, 4, 6, 5, 2]])
    derivation = Derivation.from_rules(ROADS, rules)
    assert [ROADS.kinds[k] for k in derivation.kind[0].tolist()] == ["sky", "road", "car", "dog", "road", "car", "dog"]
    of_road = group_of(derivation.kind, derivation.parent, ROADS.kind("road"))
    assert of_road.tolist() == [[-1, 1, 1, 1, 4, 4, 4]]
    of_car = group_of(derivation.kind, derivation.parent, ROADS.kind("car"))
    assert of_car.tolist() == [[-1, -1, 2, 2, -1, 5, 5]]


@given(st.lists(st.integers(0, 7), max_size=6, unique=True), st.integers(1, 7), st.integers(0, 2**31))
def test_votes_come_to_the_counts_of_each_group_in_order(places, most, seed):
    """Against a twin that walks over the cells: groups 16 pixels apart, each seen by 30 cells that vote for its middle
    within a pixel; objects anywhere, whose cells vote within 5 pixels of some group's middle."""
    generator = torch.Generator().manual_seed(seed)
    middles = [16 * place + 8 for place in sorted(places)]
    h, w, mass = 16, 20, 30
    surface, vote = torch.zeros(h * w), 128 * torch.rand(h * w, generator=generator)
    for cells, middle in zip(torch.randperm(h * w, generator=generator).split(mass), middles, strict=False):
        surface[cells] = 1
        vote[cells] = middle + 2 * torch.rand(mass, generator=generator) - 1
    objects = torch.rand(2, h * w, generator=generator) * (torch.rand(h * w, generator=generator) < 0.3)
    chosen = torch.randint(0, max(1, len(middles)), (h * w,), generator=generator)
    object_vote = torch.tensor(middles or [64])[chosen] + 10 * torch.rand(h * w, generator=generator) - 5

    expected = torch.zeros(most, 2)
    for cell in range(h * w):
        expected[min(int(chosen[cell]), most - 1)] += objects[:, cell]
    expected[max(1, len(middles)) :] = ABSENT
    shape = (1, h, w)
    maps = surface.view(shape), vote.view(shape), object_vote.view(shape)
    found = tally_groups(objects.view(1, 2, h, w), *maps, 128, mass, most)
    assert found[0, 0] == len(middles)
    assert torch.allclose(found[0, 1:].view(most, 2), expected, atol=1e-3)


def test_what_hardly_anything_votes_for_is_no_group():
    surface = torch.zeros(1, 4, 10)
    surface[0, 0, :5] = 1  # an eighth of an ordinary group
    votes = torch.full((1, 4, 10), 20.0), torch.zeros(1, 4, 10)
    found = tally_groups(torch.zeros(1, 1, 4, 10), surface, *votes, 64, 40, 3)
    assert found.tolist() == [[0, 0, ABSENT, ABSENT]]


@given(st.sampled_from([0, 1]), st.integers(0, 2**31))
def test_votes_of_objects_say_where_the_middle_is(axis, seed):
    """Two objects of one group: every cell that holds some of them points, from its own middle, at the group's."""
    generator = torch.Generator().manual_seed(seed)
    centre = STRIDE * (0.5 + 3 * torch.rand(1, 2, 2, generator=generator))
    mass, pull = object_targets(centre, torch.zeros(1, 2, dtype=torch.int64), torch.full((1, 2), 13.0), axis, 4, 4)
    cell = STRIDE * (torch.arange(4) + 0.5)
    cell = (cell.view(1, -1) if axis == 0 else cell.view(-1, 1)).expand(4, 4)
    assert torch.isclose(mass.sum(), torch.tensor(2.0), atol=1e-4)
    assert torch.allclose((cell + STRIDE * pull[0])[mass[0] > 0.01], torch.tensor(13.0), atol=1e-2)


def test_a_network_counts_by_group_along_either_axis(shelves):
    """Boxes with discs, side by side: the true counts of nearly every image after a short training."""
    view = RenderedFeatures(shelves, threads=1)
    torch.manual_seed(0)
    net = CountNet(shelves.classes, 3, shelves.canvas, (8, 16, 24), groups=shelves.groups)
    assert net.names == ("shelf", "disc 1", "disc 2", "disc 3")
    CountTraining(net, view.draw, CountSchedule(steps=360, images=8, crops=16), seed=0).run()
    batch = view.draw(200)
    scenes = batch.label
    shelf = (scenes == 0).sum(1)
    middle = batch.middle.masked_fill(batch.middle < 0, math.inf)
    true = torch.full((200, 4), ABSENT)
    true[:, 0] = shelf
    for n in range(200):
        for rank, place in enumerate(sorted(set(middle[n][scenes[n] == 0].tolist()))):
            true[n, 1 + rank] = ((scenes[n] == 1) & (middle[n] == place)).sum()
    right = (net.embed(batch.image).round() == true).all(1).float().mean()
    assert right > 0.9


def test_groups_that_make_no_sense():
    with pytest.raises(ModelError, match="along 'x' or 'y'"):
        Groups("road", along="z")
    with pytest.raises(ModelError, match="got 'y' and 0"):
        Groups("road", max_groups=0)
