"""What can be seen against plain loops over renders: which objects count, for whom, and what is said about it."""

import itertools
import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.chunks import draw_chunk
from probscene.app.evaluation.evaluate import evaluate
from probscene.app.evaluation.labels import read_labels
from probscene.app.evaluation.structure_counts import sample_counts
from probscene.app.evaluation.visible import (
    Visibility,
    count_visible,
    hidden_note,
    hidden_shares,
    visibility,
    visible_shares,
)
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model, renderer_for
from probscene.dataset import ImageFolder
from probscene.errors import ProbsceneError, RunError
from probscene.inference.statistics.count_metrics import histogram, total_variation, wasserstein

CLASSES = ("red", "blue")


@pytest.fixture(scope="module")
def model(discs):
    return load_model(str(discs.file))


@pytest.fixture(scope="module")
def drawn(model):
    """The first chunk of the prior's scenes, rendered."""
    return renderer_for(model)(draw_chunk(model, model.prior, 3, 0).drawing)


shares = st.floats(0, 1) | st.sampled_from([0.0, 0.25, 1.0])


@given(st.fixed_dictionaries({}, optional={name: shares for name in CLASSES}), st.floats(0, 30), st.integers(1, 20))
def test_objects_count_that_are_seen_well_enough(model, drawn, least, height, num):
    counts = count_visible(model, model.prior, num, 3, Visibility(height, least))
    expected = np.zeros((num, 2), np.int64)
    for n in range(num):
        for m, kind in enumerate(drawn.kind[n].tolist()):
            name = model.grammar.kinds[kind] if kind >= 0 else ""
            if name not in CLASSES or not drawn.pixels[n, m]:
                continue
            enough = float(drawn.visible[n, m]) >= np.float32(least.get(name, 0.0))
            tall = float(drawn.box[n, m, 3] - drawn.box[n, m, 1]) >= height
            expected[n, CLASSES.index(name)] += enough and tall
    assert counts.tolist() == expected.tolist()


@given(shares, shares)
def test_fewer_count_where_more_must_be_seen(model, one, other):
    low, high = sorted((one, other))
    each = [
        count_visible(model, model.prior, 10, 0, Visibility(0, visible_shares(share, CLASSES))) for share in (low, high)
    ]
    assert (each[0] >= each[1]).all() and (each[0] <= sample_counts(model, model.prior, 64, 0).counts.max()).all()


def test_shares_in_numbers_and_in_words():
    assert visible_shares(0.25, CLASSES) == {"red": 0.25, "blue": 0.25}
    assert visible_shares(["0.25", "blue=0.5"], CLASSES) == {"red": 0.25, "blue": 0.5}
    assert visible_shares(["blue=1"], CLASSES) == visible_shares({"blue": 1}, CLASSES) == {"blue": 1.0}
    assert visible_shares(["a=b=0.5"], ("a=b",)) == {"a=b": 0.5}


@pytest.mark.parametrize(
    ("given", "part"),
    [
        (1.5, "1.5"), (-0.1, "-0.1"), (float("nan"), "nan"), (["x"], "'x'"), (["red="], "''"), (["red=1.1"], "1.1"),
        (["Red=0.5"], "'Red'"), (["red=0", "red=1"], "red, got two"), (["0", "1"], "all classes, got two"),
        ({"green": 0.5}, "red, blue, got 'green'"), ({"red": "a"}, "'a'"), ({"red": True}, "True"),
    ],
)  # fmt: skip
def test_shares_that_are_none(given, part):
    with pytest.raises(ProbsceneError, match="^expected .*visible share") as error:
        visible_shares(given, CLASSES)
    assert part in str(error.value)


def test_the_hidden_are_what_is_hardly_seen(model, drawn):
    found = hidden_shares(model, model.prior, [1], 3)
    batches = [drawn, renderer_for(model)(draw_chunk(model, model.prior, 3, 1).drawing)]
    blue = [float(v) for b in batches for v in b.visible[b.kind == model.grammar.kind("blue")]]
    assert found == {"blue": pytest.approx(sum(v < 0.25 for v in blue) / len(blue))}


@pytest.fixture
def run(fitted, tmp_path):
    """The fitted run, whose labels were read at other shares."""
    shutil.copytree(fitted, tmp_path / "run")
    read = {"classes": {"red": {"visible": 0.5, "by": "labels"}, "blue": {"by": "labels"}}}
    (tmp_path / "run" / "readings.json").write_text(json.dumps(read))
    return RunFolder.at(tmp_path / "run")


def test_a_run_knows_what_labels_count(run, fitted, target):
    model = run.model
    assert run.visible_shares() == {"red": 0.5} and RunFolder.at(fitted).visible_shares() == {}
    truth = read_labels(target.labels, model, ImageFolder(target.images, model.canvas, model.channels))
    assert visibility(model, RunFolder.at(fitted), truth, None) == (None, ())
    seen, (note,) = visibility(model, run, truth, None)
    assert seen == Visibility(0.0, {"red": 0.5}) and "red 50 %, as the run's labels were read" in note
    assert visibility(model, run, truth._replace(min_height=9.0), 0.25)[0] == Visibility(
        9.0, {"red": 0.25, "blue": 0.25}
    )
    structures = truth._replace(derivation=SimpleNamespace())
    assert visibility(model, run, structures, None) == (None, ())
    with pytest.raises(ProbsceneError, match="got whole structures"):
        visibility(model, run, structures, 0.25)
    for text in ("{", "[]", '{"classes": {"red": {"visible": "much"}}}'):
        (run.path / "readings.json").write_text(text)
        with pytest.raises(RunError, match="readings.json"):
            run.visible_shares()
    (run.path / "readings.json").write_text('{"classes": {"red": {"visible": 2}}}')
    with pytest.raises(RunError, match="visible shares"):
        visibility(model, run, truth, None)


def test_shares_are_said_to_be_read_by_what_they_were_read_by(run):
    how = {"labels": "the run's labels", "histogram": "the run's labels", "agreement": "without labels"}
    for red, blue in itertools.product(how, how):
        read = {"red": {"visible": 0.5, "by": red}, "blue": {"visible": 0.25, "by": blue}}
        (run.path / "readings.json").write_text(json.dumps({"classes": read}))
        _, (note,) = visibility(run.model, run, None, None)
        groups = note.partition("visible: ")[2].split("; ")
        assert len(groups) == len({how[red], how[blue]})
        for name, by in (("red 50 %", red), ("blue 25 %", blue)):
            (group,) = [group for group in groups if name in group]
            assert how[by] in group and "labels" in group


def test_a_note_says_where_it_matters(monkeypatch, model, target):
    truth = read_labels(target.labels, model, ImageFolder(target.images, model.canvas, model.channels))
    here = "probscene.app.evaluation.visible.hidden_shares"
    monkeypatch.setattr(here, lambda *_: {"red": 0.021, "blue": 0.02})
    (note,) = hidden_note(model, model.prior, truth, None)
    assert "2 % of red" in note and "blue" not in note and "--visible 0.25" in note
    monkeypatch.setattr(here, lambda *_: {"red": 0.01})
    assert hidden_note(model, model.prior, truth, None) == ()
    monkeypatch.setattr(here, lambda *_: pytest.fail("nothing to look at"))
    for labels, seen in ((None, None), (truth, Visibility()), (truth._replace(derivation=SimpleNamespace()), None)):
        assert hidden_note(model, model.prior, labels, seen) == ()


def test_every_command_counts_what_can_be_seen(call, fitted, target, tmp_path):
    words = ["--target", target.images, "--labels", target.labels, "--num", 64, "--visible", 0.9, "--visible", "blue=1"]
    done = call("evaluate", fitted, *words, "--scenes", 0, "--json", tmp_path / "e.json")
    assert done.code == 0 and "red 90 %, blue 100 %" in done.out, done.err
    found = json.loads((tmp_path / "e.json").read_text())
    run = RunFolder.at(fitted)
    counts = count_visible(run.model, run.guide, 64, 0, Visibility(0, {"red": 0.9, "blue": 1.0}))
    assert found["sources"]["learnt"]["means"] == dict(zip(CLASSES, counts.mean(0).tolist(), strict=True))
    for c, name in enumerate(CLASSES):
        one, other = histogram(counts[:, c]), histogram(target.counts[:, c])
        apart = found["distances"]["truth"]["learnt"]["kinds"][name]
        assert apart["total_variation"]["value"] == pytest.approx(total_variation(one, other), abs=1e-6)
        assert apart["wasserstein"]["value"] == pytest.approx(wasserstein(one, other), abs=1e-6)
    done = call("compare", fitted, *words, "--out", tmp_path / "c.png", "--json", tmp_path / "c.json")
    assert done.code == 0 and "red 90 %, blue 100 %" in done.out, done.err
    again = json.loads((tmp_path / "c.json").read_text())
    assert again["distances"]["truth"]["run"]["kinds"] == found["distances"]["truth"]["learnt"]["kinds"]
    red = next(row for row in done.out.splitlines() if "red per image" in row)
    wanted = total_variation(histogram(counts[:, 0]), histogram(target.counts[:, 0]))
    moved = wasserstein(histogram(counts[:, 0]), histogram(target.counts[:, 0]))
    assert f"{wanted:.3f} {moved:.3f} ({counts[:, 0].mean():.2f})" in red
    words = words[2:]
    assert call("report", fitted, *words, "--scenes", 0, "--out", tmp_path / "r.html").code == 0
    page = (tmp_path / "r.html").read_text()
    assert "red 90 %, blue 100 %" in page and f"{moved:.3f}" in page
    (tmp_path / "few.csv").write_text("\n".join(target.labels.read_text().splitlines()[:6]))
    words[1] = tmp_path / "few.csv"
    refused = call("report", fitted, *words, "--scenes", 0, "--out", tmp_path / "few.html")
    assert refused.code == 2 and "add --some-labels" in refused.err
    assert call("report", fitted, *words, "--scenes", 0, "--out", tmp_path / "few.html", "--some-labels").code == 0
    done = call("compare", fitted, *words, "--out", tmp_path / "c.png", "--some-labels")
    assert done.code == 0 and f"({target.counts[:5, 0].mean():.2f})" in done.out, done.err
    done = call("evaluate", fitted, "--target", target.images, "--visible", "green=0.5")
    assert done.code == 2 and "red, blue, got 'green'" in done.err


def test_a_share_holds_without_labels(fitted, target):
    run = RunFolder.at(fitted)
    images = ImageFolder(target.images, run.model.canvas, run.model.channels)
    found = evaluate(run, images, None, lambda *_: None, 64, visible={"red": 1.0})
    expected = count_visible(run.model, run.guide, 64, 0, Visibility(0, {"red": 1.0}))
    assert np.array_equal(found.sources["learnt"].counts, expected)
