"""What a network's features say of classes is read by name, wherever they stand; on made-up features."""

import itertools

import pytest
import torch

from probscene.app.evaluation.estimate import estimate_counts
from probscene.grammar import Grammar
from probscene.model import Groups, SceneModel
from probscene.structure import StructurePrior

ROADS = Grammar("Scene -> Roads\nRoads -> Road Roads | ε\nRoad -> road(Cars)\nCars -> car Cars | ε")


def model(groups=None) -> SceneModel:
    return SceneModel(
        "roads", ROADS, StructurePrior(ROADS), lambda *_: None, (64, 64), 9, ("road", "car"), groups=groups
    )


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
def test_classes_are_found_by_name(order):
    columns = {"car": [3.4, 0.1], "total": [4.6, 1.2], "road": [1.2, 0.9], "light": [9.0, 9.0]}
    names = tuple(list(columns)[i] for i in order)
    counts, total, children = estimate_counts(model(), names, torch.tensor([columns[name] for name in names]).T)
    assert counts.tolist() == [[1, 3], [1, 0]] and total.tolist() == [5, 1] and children == {}


def test_counts_by_group_add_up_and_keep_their_rank():
    names = ("road", "car 1", "car 2", "car 3")
    features = torch.tensor([[2.1, 8.8, 3.2, -0.3], [0.0, 0.0, 0.0, 0.0], [4.0, 1.0, 2.0, 3.0]])
    counts, total, children = estimate_counts(model(Groups("road", max_groups=3)), names, features)
    assert counts.tolist() == [[2, 12], [0, 0], [4, 6]] and total.tolist() == [14, 0, 10]
    found = children["road", "car"]
    assert found.scene.tolist() == [0, 0, 2, 2, 2]
    assert found.rank.tolist() == [0, 1, 0, 1, 2] and found.count.tolist() == [9, 3, 1, 2, 3]


@pytest.mark.parametrize("names", [("pool_0", "pool_1"), ("road", "cart"), ("road", "car1"), ("car", "total")])
def test_features_that_count_no_class_give_no_estimate(names):
    assert estimate_counts(model(), names, torch.zeros(3, 2)) is None
