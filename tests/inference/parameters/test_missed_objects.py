"""Objects that are not found."""

import torch
from torch import Tensor

from probscene.inference.features.base import Examples
from probscene.inference.parameters.missed_objects import MAX_WEIGHT, MissedObjects
from probscene.inference.parameters.reader import Detections
from probscene.inference.parameters.reader_training import SupervisedBatch

KINDS, EACH = torch.tensor([5, 3]), 4  # kinds of the two classes; nodes a scene


def renders(number: int, seed: int = 0) -> SupervisedBatch:
    """Of scenes of two kinds of nodes in turn, with two sites."""
    torch.manual_seed(seed)
    none, kind = torch.zeros(number, EACH), KINDS.repeat(EACH // 2).expand(number, EACH).clone()
    parent = torch.full((number, EACH), -1)
    drawn = Examples(torch.zeros(0), kind, torch.rand(number, EACH, 2), none, none, none, none)
    return SupervisedBatch(drawn, kind, parent, parent, torch.rand(number, EACH, 2), torch.zeros(number, 0))


def seen(valued: SupervisedBatch) -> Tensor:
    """The first class is found by its first site, of the second all are."""
    chance = 1.2 - valued.u[..., 0]
    return (torch.rand_like(chance) < chance) | (valued.kind == KINDS[1])


def found_of(image: Tensor, label: Tensor) -> Detections:
    place = torch.zeros(len(label), 2)
    return Detections(image, torch.ones(len(label)), label, place, place, torch.zeros(len(label), 2, 6), torch.zeros(0))


def test_only_what_is_not_found_and_only_the_sites_by_which_finding_goes():
    valued = renders(600)
    there = seen(valued)
    missing = MissedObjects.from_renders(valued, KINDS, there, torch.tensor([0, 1]))
    assert (missing.label == 0).all() and len(missing.label) == int((~there).sum())
    assert torch.equal(missing.u[:, 0], valued.u[~there][:, 0])
    assert missing.u[:, 1].isnan().all()
    assert torch.allclose(missing.rate, torch.tensor([float((there & (valued.kind == 5)).sum()) / 600, EACH / 2]))


def test_nothing_is_missing_where_finding_goes_by_no_site():
    valued = renders(600)
    for there in (torch.ones(600, EACH, dtype=torch.bool), torch.rand(600, EACH) < 0.5, valued.u[..., 0] < 2e-3):
        missing = MissedObjects.from_renders(valued, KINDS, there, torch.tensor([0, 1]))
        assert not len(missing.label)
        together, u, weight = missing.impute(found_of(torch.zeros(3).long(), torch.zeros(3).long()), 1)
        assert len(together.label) == len(weight) == 3 and not len(u)


def test_with_what_is_missing_found_objects_are_a_fair_sample():
    """An iteration of EM keeps the truth, which is its fixed point."""
    valued, truth = renders(2000), renders(2000, seed=1)
    missing = MissedObjects.from_renders(valued, KINDS, seen(valued), torch.tensor([0, 1]))
    n, m = (seen(truth) & (truth.kind == KINDS[0])).nonzero(as_tuple=True)
    u = truth.u[n, m, 0]
    assert float(u.mean()) < 0.45
    together, others, weight = missing.impute(found_of(n, torch.zeros_like(n)), 2000)
    both = torch.cat([u, others[:, 0]])
    assert len(together.label) == len(weight) == len(both)
    assert abs(float((weight * both).sum() / weight.sum()) - 0.5) < 0.01


def test_what_is_missing_counts_as_often_as_its_class_is_found():
    valued = renders(600)
    missing = MissedObjects.from_renders(valued, KINDS, seen(valued), torch.tensor([0, 1]))
    number = int(10 * missing.rate[0] / 2)
    some = found_of(torch.arange(10).repeat(number)[:number], torch.zeros(number).long())
    _, u, weight = missing.impute(some, 10)
    assert len(u) and torch.allclose(weight[number:], torch.tensor(number / 10 / float(missing.rate[0])))
    many = found_of(torch.zeros(300).long(), torch.zeros(300).long())
    assert missing.impute(many, 10)[2].max() == MAX_WEIGHT
