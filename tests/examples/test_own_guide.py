"""The example of a guide of one's own: a policy that is one, and a fit with it."""

from pathlib import Path

import pytest
import torch

import probscene as ps
from probscene.app.modules import import_file
from probscene.derive import derive_complete
from probscene.policy import Policy

EXAMPLES = Path(__file__).parents[2] / "examples"
FILE = EXAMPLES / "own_guide.py"
PLACE = import_file(FILE).PlaceGuide
MODEL = ps.load_model(EXAMPLES / "tabletop.py")


@pytest.fixture
def guide():
    made = PLACE(MODEL.grammar, MODEL.max_steps)
    with torch.no_grad():
        made.table.normal_()
    return made


def test_all_steps_at_once_are_the_steps_one_by_one(guide):
    derivation, _ = derive_complete(MODEL.grammar, MODEL.prior, 50, MODEL.max_steps)
    assert torch.equal(guide.logits(derivation), Policy.logits(guide, derivation))


def test_pretrained_it_is_a_prior_of_lists(guide):
    ps.pretrain(guide, MODEL.prior, num_derivations=2000, epochs=10, learning_rate=3e-2)
    held_out, _ = derive_complete(MODEL.grammar, MODEL.prior, 1000, MODEL.max_steps)
    assert -guide.log_prob(held_out).mean() < -MODEL.prior.log_prob(held_out).mean() + 0.1


def test_it_is_fitted(both_ways):
    ways = both_ways(["--guide", f"{FILE}:PlaceGuide"], {"guide": PLACE})
    learnt, again = ways.python.guide, ps.Run.open(ways.command).guide
    assert type(learnt) is PLACE and type(again).__name__ == "PlaceGuide"
    assert torch.equal(learnt.table, again.table) and learnt.table.abs().sum() > 0
    assert len(ways.python.sample(3).derivation) == 3


def test_it_goes_on_to_the_same_bytes(goes_on):
    goes_on("structure", guide=PLACE)
