"""Lists that are too short and images that a model cannot have: who is named, by how much, and with what remedy."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.app.evaluation.evaluate import evaluate
from probscene.app.evaluation.labels import Labels
from probscene.app.evaluation.prior_limits import (
    FEWER,
    MORE,
    more_room,
    qualified_name,
    read_lengths,
    saturated_lists,
    saturation_warnings,
    unreachable_counts,
)
from probscene.app.evaluation.sources import Source
from probscene.app.evaluation.structure_counts import StructureCounts
from probscene.app.fitting.run import RunFolder
from probscene.dataset import ImageFolder
from probscene.enumeration import enumerate_derivations
from probscene.grammar import Grammar
from probscene.lists import bounded_lists
from probscene.model import Groups, SceneModel
from probscene.relations import PerParent
from probscene.scenarios import join
from probscene.structure import StructurePrior, counts, ranked, weights

BLOOD = Grammar("""
    Scene     -> Reds Whites Platelets
    Reds      -> red Reds | ε
    Whites    -> wbc Whites | wbc
    Platelets -> platelet Platelets | ε
""")
CLASSES = ("red", "wbc", "platelet")
PRIOR = StructurePrior(BLOOD, Reds=counts(0, 0, 1, 1), Whites=counts(1, 1), Platelets=counts(1, 1, 1))


def blood(prior=PRIOR, max_steps=40, **more):
    return SceneModel("blood", prior.grammar, prior, lambda n, s: None, (32, 32), max_steps, CLASSES, **more)


def learnt(**lists):
    """A guide that has learnt these lengths."""
    return StructurePrior(BLOOD, **{"Reds": counts(0, 0, 1, 1), "Whites": counts(1, 1), **lists})


def test_a_list_at_its_end_is_named_with_the_length_that_the_network_sees():
    seen = Source.from_counts(np.array([[2, 1, n] for n in (2, 2, 3, 4, 6, 9)]))
    (found,) = saturated_lists(blood(), learnt(Platelets=counts(0, 1, 9)), seen)
    assert (found.name, found.longest, found.beyond_prior) == ("Platelets", 2, False)
    assert found.learnt == pytest.approx(0.9, abs=0.03) and found.declared == pytest.approx(1 / 3)
    assert found.longer_images == pytest.approx(4 / 6) and found.length == 10
    assert "Platelets=counts(...) up to 10, such as Platelets=counts(*[1] * 11)" in str(found)
    assert "67 % of the images" in str(found) and "first try" not in str(found)
    assert json.loads(json.dumps(found.record()))["length"] == 10


def test_without_counts_of_it_a_first_try_is_proposed():
    (found,) = saturated_lists(blood(), learnt(Platelets=counts(0, 1, 9)), None)
    assert found.longer_images is None and found.length == 4 and "as a first try" in str(found)


def test_an_end_that_is_the_targets_own_is_not_named():
    seen = Source.from_counts(np.array([[2, 1, 2]] * 30))
    assert saturated_lists(blood(), learnt(Platelets=counts(0, 1, 9)), seen) == ()
    assert saturated_lists(blood(), PRIOR, None) == ()  # nothing was learnt
    longer = Source.from_counts(np.array([[2, 1, 7]] * 10 + [[2, 1, 1]] * 20))
    (found,) = saturated_lists(blood(), PRIOR, longer)  # nor could it be
    assert found.name == "Platelets" and found.length == 8


def test_a_prior_whose_lists_are_mostly_at_their_end_is_no_finding():
    prior = StructurePrior(BLOOD, Platelets=counts(1, 9), Reds=counts(1, 1), Whites=counts(1, 1))
    assert (
        saturated_lists(
            blood(prior), StructurePrior(BLOOD, Platelets=counts(0, 1), Reds=counts(1, 1), Whites=counts(1, 1)), None
        )
        == ()
    )


def test_lists_beyond_the_prior_within_pretraining_are_named():
    more = StructurePrior(BLOOD, Reds=counts(0, 0, 1, 1), Whites=counts(1, 1), Platelets=counts(3, 3, 3, *[0.25] * 4))
    (found,) = saturated_lists(blood(pretraining=more), learnt(Platelets=counts(0, 0, 1, 1, 1)), None)
    assert found.beyond_prior and (found.longest, found.length) == (2, 4)
    assert "longer than the prior's maximum, 2" in str(found)
    assert saturation_warnings([found]) == [f"Note: {found}"]
    other = replace(found, name="Reds", beyond_prior=False)
    first, second = saturation_warnings([found, other, found])
    assert first == f"Warning: {other}" and second.count("Platelets up to 4 (") == 2


def test_a_list_without_an_end_and_a_policy_that_is_no_table_are_left_alone():
    prior = StructurePrior(BLOOD, Reds=weights(3, 1), Whites=weights(1, 3), Platelets=weights(1, 1))
    assert saturated_lists(blood(prior), prior, None) == ()


NESTED = Grammar(
    "Scene -> Plates\nPlates -> Plate Plates | ε\nPlate -> wbc(Mugs)\nMugs -> red Mugs | platelet Mugs | ε"
)
RANKED = StructurePrior(NESTED, Plates=counts(1, 1, 1), Mugs=ranked(counts(1, 1), counts(1, 1, 1, 1)))


def test_lists_below_a_group_are_read_from_its_counts_by_rank():
    model = blood(RANKED, groups=Groups("wbc", along="x"))
    first, rest = (b for b in bounded_lists(NESTED, RANKED, model.support) if b.symbol == 3)
    each = [
        PerParent(torch.tensor([0, 0, 1]), torch.tensor([0, 1, 0]), torch.tensor(n)) for n in ((1, 3, 3), (2, 0, 0))
    ]
    read = Source.from_counts(np.array([[4, 2, 2], [3, 1, 0]]), {("wbc", "red"): each[0], ("wbc", "platelet"): each[1]})
    assert read_lengths(model, first, read).tolist() == [3, 3] and read_lengths(model, rest, read).tolist() == [3]
    assert read_lengths(blood(RANKED), first, read) is None
    guide = StructurePrior(NESTED, Plates=counts(1, 1, 1), Mugs=ranked(counts(0, 1), counts(1, 1, 1, 1)))
    (found,) = saturated_lists(model, guide, read)
    assert (found.rank, found.longest, found.length) == (0, 1, 4)
    assert "Mugs=ranked(...) with counts(...) up to 4 at rank 1" in str(found)


def test_unreachable_images_are_named_with_what_would_allow_them():
    numbers = np.array([[2, 1, 0], [3, 2, 2], [3, 0, 5], [2, 1, 9], [1, 1, 1], [2, 3, 0]])
    names = [f"{i}.png" for i in range(6)]
    found = {
        (x.what, x.side): x for x in unreachable_counts(blood(), Source.from_counts(numbers), CLASSES, True, names)
    }
    assert {key: (x.limit, x.rows) for key, x in found.items()} == {
        ("red", FEWER): (2, (4,)), ("wbc", MORE): (2, (5,)), ("wbc", FEWER): (1, (2,)), ("platelet", MORE): (2, (2, 3)),
    }  # fmt: skip
    assert str(found["platelet", MORE]).startswith(
        "2 of 6 images show more than 2 platelet, the model's maximum (2.png, 3.png). To allow that: "
        "Platelets=counts(...) up to 9, such as Platelets=counts(*[1] * 10)"
    )
    assert "Reds=counts(...) from 1 up to 3, such as Reds=counts(*[0] * 1, *[1] * 3)" in str(found["red", FEWER])
    assert "Whites=counts(...) up to 2" in str(found["wbc", MORE])
    assert "let the grammar leave it out, such as by ε beside 'Whites -> wbc" in str(found["wbc", FEWER])
    assert json.dumps([x.record() for x in found.values()])


def test_a_scene_may_have_more_than_can_be_seen():
    numbers = Source.from_counts(np.array([[0, 0, 0], [9, 1, 1]]))
    (found,) = unreachable_counts(blood(), numbers, CLASSES, True, visible=True)
    assert (found.what, found.side, found.rows) == ("red", MORE, (1,))


def test_few_images_by_a_networks_counts_are_passed_over():
    numbers = np.array([[2, 1, 1]] * 200)
    numbers[0] = 2, 1, 7
    assert unreachable_counts(blood(), Source.from_counts(numbers), CLASSES, False) == ()
    assert len(unreachable_counts(blood(), Source.from_counts(numbers), CLASSES, True)) == 1


def test_t_max_weights_and_the_grammar_are_named_where_they_are_the_limit():
    text = "Scene -> Reds Night\nReds -> red Reds | ε\nNight -> wbc platelet | ε"
    grammar = Grammar(text)
    prior = StructurePrior(grammar, Reds=weights(1, 1), Night=weights(0, 1))
    model = blood(prior, max_steps=6)

    def remedy(*numbers, **more):
        found = unreachable_counts(model, Source.from_counts(np.array([numbers])), CLASSES, True, **more)
        return [(x.what, x.side, x.remedy) for x in found]

    assert remedy(7, 0, 0)[0] == ("red", MORE, "max_steps=10")
    what, side, said = remedy(0, 1, 1)[0]
    assert (what, side) == ("wbc", MORE) and "Night a weight above 0 for 'Night -> wbc platelet'" in said
    what, side, said = remedy(0, 2, 0)[0]
    assert (what, side) == ("wbc", MORE) and "Wbcs -> wbc Wbcs | ε" in said


@settings(max_examples=15)
@given(st.lists(st.integers(1, 6), min_size=3, max_size=3), st.data())
def test_unreachable_is_what_no_derivation_counts(most, data):
    """Of a class, or of all objects."""
    prior = StructurePrior(
        BLOOD, **{name: counts(*[1] * n) for name, n in zip(("Reds", "Whites", "Platelets"), most, strict=True)}
    )
    model = blood(prior, max_steps=16)
    every = enumerate_derivations(BLOOD, 16)
    possible = every.counts(3)[prior.log_prob(every) > -torch.inf].numpy()
    numbers = np.array(data.draw(st.lists(st.tuples(*[st.integers(0, 8)] * 3), min_size=1, max_size=12)))
    rows = {
        row for found in unreachable_counts(model, Source.from_counts(numbers), CLASSES, True) for row in found.rows
    }
    with_totals = (np.column_stack([x, x.sum(1)]) for x in (numbers, possible))
    asked, possible = with_totals
    outside = (asked > possible.max(0)) | (asked < possible.min(0))
    assert rows == set(np.flatnonzero(outside.any(1)).tolist())


def test_a_scenarios_list_is_named_with_its_scenario():
    model = join("both", {"day": blood(), "night-shift": blood()})
    name = model.grammar.nonterminals.index("Platelets-night-shift")
    assert qualified_name(model.grammar, name) == "Platelets of scenario 'night-shift'"
    (bounds,) = (b for b in bounded_lists(model.grammar, model.prior, model.support) if b.symbol == name)
    assert more_room(model, bounds, 5).startswith("Platelets=counts(...) in scenario 'night-shift' up to 5, such as Pl")


def test_an_evaluation_says_both(fitted, target, discs):
    run = RunFolder.at(fitted)
    narrow = replace(run.model, prior=StructurePrior(run.model.grammar, Discs=counts(1, 1)))
    run = RunFolder(run.path, run.record, narrow)
    truth = Labels(StructureCounts(target.counts, {}))
    images = ImageFolder(target.images, (64, 64), 3)
    found = evaluate(run, images, truth, lambda *_: None, num=50)
    over = int((target.counts.sum(1) > 1).sum())
    rows = {row for each in found.unreachable_counts for row in each.rows}
    assert len(rows) == over and found.unreachable_counts[0].names[0].endswith(".png")
    record = json.loads(json.dumps(found.record()))["walls"]
    assert [x["sentence"] for x in record["images"]] == [str(x) for x in found.unreachable_counts]
    assert f"{over} images have counts that the model cannot generate" in found.prior_warning and len(
        found.warnings
    ) == len(found.unreachable_counts) + len(found.saturated_lists)


LIT = '''

class Lit:
    """How many discs of each colour the lit pixels are."""

    names = ("red", "blue")

    def embed(self, images):
        import torch

        lit = (images.float() > 128).flatten(2).sum(2)
        return torch.stack([lit[:, 0], lit[:, 2]], 1) / 113.0
'''


def test_a_finished_fit_warns_and_evaluate_repeats_it(call, discs, target, tmp_path):
    """The discs' prior, cut to lists of at most one: seen as they are, most are longer."""
    model = tmp_path / "narrow.py"
    text = discs.file.read_text(encoding="utf-8")
    text = text.replace("model((1, 1, 1, 1), (1, 1), target", "model((1, 1), (1, 1), target") + LIT
    model.write_text(text, encoding="utf-8")
    settings = [*discs.without("features", "parameters"), "--learn", "structure", "--features", f"{model}:Lit"]
    settings += ["--set", "structure.batches=30", "--set", "structure.learning_rate=0.05"]
    out = tmp_path / "run"
    done = call("fit", model, "--target", target.images, "--out", out, *settings)
    assert done.code == 0, done.err
    said = [line for line in done.err.splitlines() if line.startswith("Warning: Discs: ")]
    assert len(said) == 1 and "Discs=counts(...) up to" in said[0]
    assert RunFolder.at(out).guide.support is not None
    before = {key: value for key, value in RunFolder.at(out).record.items() if key != "within_support"}
    assert RunFolder(out, before).guide.support is None  # a run of an earlier version stays as it was
    judged = call("evaluate", out, "--target", target.images, "--num", 500, "--json", tmp_path / "found.json")
    assert judged.code == 0, judged.err
    assert said[0] in judged.out and "The prior is too narrow: lists reach their maximum length (Discs)" in judged.out
    assert json.loads((tmp_path / "found.json").read_text())["walls"]["lists"][0]["name"] == "Discs"
    page = call("report", out, "--num", 200, "--scenes", 40)
    assert page.code == 0 and "Warning: Discs: " in (out / "report.html").read_text(encoding="utf-8")
