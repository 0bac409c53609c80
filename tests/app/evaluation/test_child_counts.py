"""Structures as labels: counts below parents and by rank, likelihoods, and how they are shown; on plates with mugs."""

import json
import math
import random
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats
import torch

from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.evaluate import evaluate
from probscene.app.evaluation.labels import TargetLabels, counts_of_dataset, read_labels
from probscene.app.evaluation.likelihood import likelihood
from probscene.app.evaluation.structure_counts import group_label
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.app.views.report import report, write
from probscene.dataset import ImageFolder
from probscene.derivation import Derivation
from probscene.errors import DataError
from probscene.structure import StructurePrior, counts, ranked

PLATES = Path(__file__).parents[1] / "plates.py"
PAIR = ("plate", "mug")


def quiet(*_):
    pass


@pytest.fixture(scope="module")
def plates(call, discs, tmp_path_factory) -> SimpleNamespace:
    """A run, and 60 images of another structure with their provenance: up to three plates, the first one full."""
    folder = tmp_path_factory.mktemp("plates")
    model = load_model(str(PLATES))
    structure = StructurePrior(
        model.grammar, Plates=counts(0.1, 0.3, 0.3, 0.3), Mugs=ranked(counts(0, 0, 1), counts(0.5, 0.5))
    )
    generate_scenes(model, structure, 60, folder / "drawn", format="images")
    images, lines = folder / "drawn" / "images", folder / "drawn" / "provenance.jsonl"
    done = call("fit", PLATES, "--target", images, "--out", folder / "run", *discs.settings)
    assert done.code == 0, done.err
    opened = ImageFolder(images, model.canvas, model.channels)
    run = RunFolder.at(folder / "run")
    return SimpleNamespace(run=run, images=images, lines=lines, opened=opened, structure=structure)


@pytest.fixture(scope="module")
def found(plates):
    return evaluate(plates.run, plates.opened, read_labels(plates.lines, plates.run.model, plates.opened), quiet, 800)


def spelt(lines: Path) -> list[list[int]]:
    """The mugs on each plate of each image, read from the rules' text."""
    scenes = []
    for line in map(json.loads, lines.read_text(encoding="utf-8").splitlines()):
        scene = []
        for rule in line["derivation"].split("; "):
            if rule.startswith("Plate ->"):
                scene.append(0)
            elif rule == "Mugs -> mug Mugs":
                scene[-1] += 1
        scenes.append(scene)
    return scenes


def test_structures_of_provenance_are_counted_below_parents_and_by_rank(plates, found):
    scenes = spelt(plates.lines)
    truth = found.sources["truth"]
    assert list(truth.nested) == [PAIR]
    groups = {
        "parents": [len(scene) for scene in scenes],
        "all": [n for scene in scenes for n in scene],
        "first": [scene[0] for scene in scenes if scene],
        "second": [scene[1] for scene in scenes if len(scene) > 1],
        "third": [scene[2] for scene in scenes if len(scene) > 2],
        "others": [n for scene in scenes for n in scene[1:]],
        "fourth": [],
        "later": [],
    }
    for group, numbers in groups.items():
        tally = truth.nested[PAIR][group]
        assert tally.total.tolist() == np.bincount(numbers, minlength=len(tally.total)).tolist() or not numbers
        assert tally.empty == (not numbers)
    assert set(groups["first"]) == {2} and set(groups["others"]) <= {0, 1}
    _, same = counts_of_dataset(plates.run.model, plates.lines.parent)
    assert np.array_equal(truth.counts, same)


def test_distances_below_parents_are_those_of_the_counts(found):
    record = json.loads(json.dumps(found.record(), allow_nan=False))
    for a in ("prior", "learnt"):
        measured = record["distances"]["truth"][a]
        for group, distance in measured["children"]["mug per plate"].items():
            one, other = (found.sources[s].nested[PAIR][group].total for s in (a, "truth"))
            if not one.any() or not other.any():
                assert distance is None
                continue
            size = max(len(one), len(other))
            p, q = (np.pad(x / x.sum(), (0, size - len(x))) for x in (one, other))
            assert distance["total_variation"]["value"] == pytest.approx(abs(p - q).sum() / 2)
            expected = scipy.stats.wasserstein_distance(range(size), range(size), p, q)
            assert distance["wasserstein"]["value"] == pytest.approx(expected)
        kinds = {name: measured["kinds"][name]["total_variation"]["value"] for name in found.classes}
        assert kinds == pytest.approx(measured["each_class"])
    first = record["distances"]["truth"]["prior"]["children"]["mug per plate"]["first"]["total_variation"]
    assert first["low"] < 0.7 < first["high"]  # the prior has two mugs on 0.3 of the plates, the target on every first
    assert (
        "mug per plate" not in record["distances"]["estimate"]["prior"]["children"]
    )  # this network counts no plates' mugs
    assert record["sources"]["truth"]["children"]["mug per plate"]["first"]["mean"]["value"] == 2


def test_labels_that_are_structures_tell_what_a_policy_makes_of_them(plates, found):
    model = plates.run.model
    rules = [json.loads(line)["rules"] for line in plates.lines.read_text(encoding="utf-8").splitlines()]
    each = [Derivation.from_rules(model.grammar, torch.tensor([row])) for row in rules]
    for name, policy in (("prior", model.prior), ("learnt", plates.run.guide)):
        with torch.no_grad():
            logp = np.array([policy.log_prob(one).item() for one in each])
        possible = np.isfinite(logp)
        nats, impossible = found.likelihoods[name]
        assert nats.value == pytest.approx(logp[possible].mean(), rel=1e-5) and nats.low < nats.value < nats.high
        assert impossible == pytest.approx(1 - possible.mean())
    long = np.mean([len(scene) > 2 for scene in spelt(plates.lines)])
    assert found.likelihoods["prior"].impossible == pytest.approx(long)
    assert found.likelihoods["learnt"].impossible == found.likelihoods["prior"].impossible  # nor may the guide


def test_a_policy_that_derives_none_of_the_structures(plates):
    grammar = plates.run.model.grammar
    labels = read_labels(plates.lines, plates.run.model, plates.opened)
    assert likelihood(StructurePrior(grammar, Plates=counts(0, 0, 0, 0, 1)), labels.derivation) == (None, 1.0)
    own = likelihood(plates.structure, labels.derivation)
    assert own.impossible == 0 and math.isfinite(own.nats.value)


def test_the_command_shows_what_depends_on_context(call, plates, found, tmp_path):
    words = ["evaluate", plates.run.path, "--target", plates.images, "--num", 800, "--scenes", 0]
    shown = call(*words, "--labels", plates.lines, "--json", tmp_path / "e.json")
    assert shown.code == 0, shown.err
    assert json.loads((tmp_path / "e.json").read_text()) == json.loads(json.dumps(found.record()))
    for group in ("all", "first", "others"):
        value = found.distance("prior", "truth")["children"]["mug per plate"][group]["total_variation"]["value"]
        name = group_label(PAIR, group)[:12]  # a long name goes on in the line below
        assert any(name in line and f"{value:.3f}" in line for line in shown.out.splitlines())
    assert "impossible" in shown.out and "log q" in shown.out
    plain = call(*words)
    assert plain.code == 0 and "mug per first plate" in plain.out and "log q" not in plain.out


def test_a_model_without_nesting_shows_nothing_new(call, fitted, target):
    shown = call("evaluate", fitted, "--target", target.images, "--labels", target.labels, "--num", 100, "--scenes", 0)
    lines = [line for line in shown.out.splitlines() if not line.startswith(("Warning: ", "Next: "))]
    titles = [line.strip() for line in lines if line and line[0].isalpha()]
    assert [title.split(",")[0] for title in titles] == [
        "Distance to the truth", "TV: total variation", "Distance to what the feature network reads *",
        "Images by number of objects", "Objects by class", "Counts read in each labelled image"]  # fmt: skip


def test_the_report_has_charts_of_what_depends_on_context(plates, found, tmp_path):
    text = write(plates.run, found, plates.opened, tmp_path / "r.html").read_text(encoding="utf-8")
    for group in ("all", "first", "second", "others"):
        assert text.count(group_label(PAIR, group)) >= 2  # a chart and a table
    assert "log q of the labelled structures" in text and "impossible" in text
    from probscene.app.progress import Display

    labelled = report(plates.run, Display(), tmp_path / "s.html", TargetLabels(plates.lines), num=200, judged_by=0)
    assert "log q of the labelled structures" in labelled.read_text(encoding="utf-8")


def test_lines_may_stand_in_any_order_and_blank_ones_between(plates, tmp_path):
    lines = plates.lines.read_text(encoding="utf-8").splitlines()
    random.Random(0).shuffle(lines)
    (tmp_path / "p.jsonl").write_text("\n\n".join(lines), encoding="utf-8")
    one, other = (read_labels(path, plates.run.model, plates.opened) for path in (plates.lines, tmp_path / "p.jsonl"))
    assert torch.equal(one.derivation.rules, other.derivation.rules)


def edited(number, **changes):
    def change(lines):
        line = json.loads(lines[number])
        lines[number] = json.dumps({key: value for key, value in (line | changes).items() if value is not ...})
        return lines

    return change


def tampered(lines):
    """Line 4 ends before its structure does."""
    line = json.loads(lines[3])
    line["rules"], line["derivation"] = line["rules"][:-1], "; ".join(line["derivation"].split("; ")[:-1])
    return [*lines[:3], json.dumps(line), *lines[4:]]


LINES = {
    "no JSON": (lambda lines: [*lines[:4], "{", *lines[5:]], "line 5"),
    "no object": (lambda lines: [*lines[:4], "[1]", *lines[5:]], "line 5"),
    "no rules": (edited(2, rules=...), "line 3"),
    "other rules": (edited(2, rules=[0]), "line 3", "another grammar"),
    "no numbers": (edited(2, rules=["a"]), "line 3", "another grammar"),
    "rules that are not there": (edited(2, rules=[99]), "line 3", "another grammar"),
    "empty": (edited(2, rules=[], derivation=""), "line 3", "another grammar"),
    "not ended": (tampered, "000003.png", "structures of model 'plates'"),
    "unknown image": (edited(2, image="images/x.png"), "line 3", "'x.png'"),
    "twice": (lambda lines: [*lines, lines[7]], "second one of 000007.png", "line 61"),
    "missing": (lambda lines: lines[:-2], "000058.png and 1 more"),
}


@pytest.mark.parametrize("fault", LINES)
def test_wrong_lines_of_provenance(fault, plates, tmp_path):
    change, *parts = LINES[fault]
    lines = change(plates.lines.read_text(encoding="utf-8").splitlines())
    (tmp_path / "p.jsonl").write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(DataError, match="^expected ") as refused:
        read_labels(tmp_path / "p.jsonl", plates.run.model, plates.opened)
    assert all(part in str(refused.value) for part in parts), refused.value


def test_a_structure_of_another_shape_is_refused(plates, tmp_path):
    model = plates.run.model
    rules = [k for k, rule in enumerate(model.grammar.rules) if str(rule).startswith("Plates")]
    text = "; ".join(str(model.grammar.rules[k]) for k in rules)
    lines = edited(2, rules=rules, derivation=text)(plates.lines.read_text(encoding="utf-8").splitlines())
    (tmp_path / "p.jsonl").write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(DataError, match="000002.png"):
        read_labels(tmp_path / "p.jsonl", model, plates.opened)
