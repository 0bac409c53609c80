"""Evaluation: counts against plain loops, labels read strictly, estimates called estimates."""

import io
import json
import random
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console

from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation.compare import compare
from probscene.app.evaluation.count_errors import count_errors
from probscene.app.evaluation.evaluate import ImageComparison, evaluate, network_counts
from probscene.app.evaluation.labels import Labels, counts_of_dataset
from probscene.app.evaluation.sources import Source
from probscene.app.evaluation.structure_counts import StructureCounts, sample_counts
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.counts import read_table, write_counts
from probscene.app.loading import load_model
from probscene.app.views.comparison import draw
from probscene.app.views.tables import show
from probscene.dataset import ImageFolder
from probscene.errors import DataError

CLASSES = ("red", "blue")


def quiet(*_):
    pass


def structure_counts(model, policy, num, seed, each=None):
    return sample_counts(model, policy, num, seed, each).counts


def labels(counts) -> Labels:
    return Labels(StructureCounts(counts, {}))


def opened(folder) -> ImageFolder:
    return ImageFolder(folder, (64, 64), 3)


def test_counts_of_a_dataset_are_those_of_its_derivations(target, discs):
    truth = load_model(str(discs.file)).target(0)
    names, counts = counts_of_dataset(truth, target.images.parent)
    assert names == sorted(file.name for file in target.images.iterdir())
    lines = (target.images.parent / "provenance.jsonl").read_text(encoding="utf-8").splitlines()
    spelt = [json.loads(line)["derivation"] for line in lines]
    assert counts.tolist() == [[text.count("-> red"), text.count("-> blue")] for text in spelt]


def test_structures_are_counted_as_their_distribution_says(discs):
    model = load_model(str(discs.file)).target(0)  # number .1 .1 .2 .6, red 4 of 5
    told = []
    counts = structure_counts(model, model.prior, 4200, 0, told.append)
    assert sum(told) == len(counts) == 4200
    number = np.bincount(counts.sum(1))
    assert scipy.stats.chisquare(number, 4200 * np.array([0.1, 0.1, 0.2, 0.6])).pvalue > 1e-3
    assert scipy.stats.binomtest(int(counts[:, 0].sum()), int(counts.sum()), 0.8).pvalue > 1e-3
    assert np.array_equal(structure_counts(model, model.prior, 4200, 0), counts)
    assert np.array_equal(structure_counts(model, model.prior, 1000, 0), counts[:1000])
    assert not np.array_equal(structure_counts(model, model.prior, 4200, 1), counts)


def test_distances_are_those_between_the_counts(fitted, target):
    run = RunFolder.at(fitted)
    found = evaluate(run, opened(target.images), labels(target.counts), quiet, num=600)
    assert list(found.sources) == ["prior", "learnt", "truth", "estimate"]
    assert np.array_equal(found.sources["prior"].counts, structure_counts(run.model, run.model.prior, 600, 0))
    assert np.array_equal(found.sources["learnt"].counts, structure_counts(run.model, run.guide, 600, 0))
    assert found.sources["truth"].counts is target.counts
    measured = found.distances()
    for b in ("truth", "estimate"):
        for a in ("prior", "learnt"):
            one, other = (found.read if b == "estimate" else found.sources)[a], found.sources[b]
            share = [np.bincount(s.total, minlength=20) / len(s.total) for s in (one, other)]
            assert measured[b][a]["number"] == pytest.approx(abs(share[0] - share[1]).sum() / 2)
            expected = scipy.stats.wasserstein_distance(one.total, other.total)
            assert measured[b][a]["number_wasserstein"] == pytest.approx(expected)
            pooled = [s.counts.sum(0) / s.counts.sum() for s in (one, other)]
            assert measured[b][a]["classes"] == pytest.approx(abs(pooled[0] - pooled[1]).sum() / 2)
            assert set(measured[b][a]["each_class"]) == set(CLASSES)


counted = st.lists(st.tuples(st.floats(-1, 30), st.integers(0, 30)), min_size=3, max_size=40)


@given(counted)
def test_errors_of_counts_are_those_of_the_definitions(pairs):
    read, labelled = (np.array(side) for side in zip(*pairs, strict=True))
    found = count_errors(read, labelled)
    assert found.images == len(pairs)
    assert found.mean_absolute.value == pytest.approx(sum(abs(a - b) for a, b in pairs) / len(pairs))
    error, rounding = found.mean_absolute, 1e-9
    assert 0 <= error.low <= error.value + rounding and error.value <= error.high + rounding
    if read.std() < 1e-9 or labelled.std() == 0:
        assert found.correlation is None
    elif read.std() > 1e-3:
        assert found.correlation.value == pytest.approx(scipy.stats.pearsonr(read, labelled).statistic, abs=1e-6)
        assert -1 <= found.correlation.low <= found.correlation.high <= 1
    exact = count_errors(labelled.astype(float), labelled)
    assert exact.mean_absolute == (0, 0, 0)
    assert exact.correlation is None or exact.correlation.value == pytest.approx(1)


def test_intervals_of_errors_hold_the_truth_as_often_as_they_say():
    """For a normal error of variance 1 the mean absolute one is sqrt(2 / pi); readings with it go with labels of
    variance 1 at sqrt(1 / 2)."""
    rng, held = np.random.default_rng(0), np.zeros(2)
    for _ in range(200):
        labelled = rng.poisson(100, 80)
        read = labelled + rng.normal(0, 10, 80)
        found = count_errors(read, labelled)
        true = 10 * np.sqrt(2 / np.pi), np.sqrt(1 / 2)
        held += [x.low <= t <= x.high for x, t in zip(found[1:3], true, strict=True)]
    assert (held >= 176).all()  # 95 % less five standard deviations, and what a bootstrap of 80 images lacks


def test_what_was_read_of_each_image_is_held_against_its_labels(fitted, target):
    run = RunFolder.at(fitted)
    read = run.read_tensors("real")["features"][:, :2].numpy()
    rows = [30, 3, 11, 20]
    some = labels(target.counts[sorted(rows)])._replace(rows=sorted(rows))
    for truth, chosen in ((labels(target.counts), slice(None)), (some, sorted(rows))):
        found = evaluate(run, opened(target.images), truth, quiet, num=20)
        for c, name in enumerate(CLASSES):
            error = np.abs(read[chosen, c] - target.counts[chosen, c]).mean()
            assert found.errors[name].mean_absolute.value == pytest.approx(error)
            assert found.record()["count_errors"][name]["mean_absolute"]["value"] == pytest.approx(error)
    table = found_table(found)
    assert "Counts read in each labelled image" in table and f"{found.errors['red'].mean_absolute.value:.2f}" in table
    assert not evaluate(run, opened(target.images), None, quiet, num=20).errors
    paper = RunFolder(run.path, run.record | {"config": run.config.with_features("presence").to_record()})
    without = evaluate(paper, opened(target.images), labels(target.counts), quiet, num=20)
    assert without.errors == dict.fromkeys(CLASSES) and re.search(r"red +│ +- │ +- │ +- ", found_table(without))


def found_table(evaluation) -> str:
    console = Console(width=200, file=io.StringIO())
    show(evaluation, console)
    return console.file.getvalue()


def test_shares_of_no_objects_are_not_compared(fitted, target):
    found = evaluate(RunFolder.at(fitted), opened(target.images), labels(np.zeros((40, 2), np.int64)), quiet, num=50)
    assert found.distance("prior", "truth")["classes"] is None
    json.dumps(found.record(), allow_nan=False)


def test_the_estimate_is_what_the_network_counts(fitted, target, tmp_path):
    run = RunFolder.at(fitted)
    kept = network_counts(run, opened(target.images), quiet)
    features = run.read_tensors("real")["features"]
    assert np.array_equal(kept.counts, np.rint(features[:, :2].numpy()).astype(int))
    assert np.array_equal(kept.total, np.rint(features[:, 2].numpy()).astype(int))
    shutil.copytree(target.images, tmp_path / "copy")
    (tmp_path / "copy" / "000039.png").rename(tmp_path / "copy" / "999999.png")  # another folder to the fit
    told = []
    anew = network_counts(run, opened(tmp_path / "copy"), lambda *said: told.append(said))
    assert told[-1][:3] == ("target", 40, 40)
    assert np.array_equal(anew.counts, kept.counts) and np.array_equal(anew.total, kept.total)
    without = network_counts(run, None, quiet)
    assert np.array_equal(without.counts, kept.counts)


def test_readings_are_compared_with_readings_so_that_the_networks_errors_cancel(fitted, tmp_path):
    """Of the very images that are generated with the learnt structures nothing is left, though the network, which has
    hardly been trained, counts them wrongly."""
    run = RunFolder.at(fitted)
    generate_scenes(run.model, run.guide, 70, tmp_path / "own", 3, "images")
    images = opened(tmp_path / "own" / "images")
    found = evaluate(run, images, None, quiet, num=70, seed=3)
    apart = found.distances()["estimate"]["learnt"]
    assert apart["number"] == apart["classes"] == apart["number_wasserstein"] == 0 == max(apart["each_class"].values())
    assert (found.sources["learnt"].counts != found.sources["estimate"].counts).any()
    assert compare({"run": run}, images, None, quiet, 70, 3).distances()["estimate"]["run"] == apart
    assert list(found.shown) == ["prior", "learnt", "read", "estimate"]
    (mean,) = {found.shown[name].total.mean() for name in ("read", "estimate")}
    console = Console(width=200, file=io.StringIO())
    show(found, console)
    assert console.file.getvalue().count(f"{mean:.2f}") >= 4  # twice among distances, twice below histograms


def test_a_network_that_does_not_count_gives_no_estimate(fitted, target):
    run = RunFolder.at(fitted)
    paper = RunFolder(run.path, run.record | {"config": run.config.with_features("presence").to_record()})
    assert network_counts(paper, opened(target.images), quiet) is None
    assert list(evaluate(paper, None, None, quiet, num=20).sources) == ["prior", "learnt"]


def test_where_fits_set_out_from_another_policy_it_is_a_source(fitted, target, tmp_path):
    run = RunFolder.at(fitted)
    start = load_model(str(run.record["model"])).target(0).prior
    run._model = replace(run.model, pretraining=start)
    found = evaluate(run, opened(target.images), None, quiet, num=200, compared=ImageComparison(["run"], 8))
    assert list(found.sources) == ["prior", "start", "learnt", "estimate"]
    assert np.array_equal(found.sources["start"].counts, structure_counts(run.model, start, 200, 0))
    assert list(found.distances()["estimate"]) == ["prior", "start", "learnt"] == list(found.images["run"])[:3]
    assert list(found.images["run"]) == ["prior", "start", "learnt", "floor"]
    json.dumps(found.record())
    console = Console(width=200, file=io.StringIO())
    show(found, console)
    assert console.file.getvalue().count("initialisation") >= 4
    several = compare({"one": run}, opened(target.images), None, quiet, num=50)
    assert list(several.sources) == ["prior", "start", "one", "estimate"]
    assert list(several.distances()["estimate"]) == ["prior", "start", "one"]
    draw(several, tmp_path / "compared.png")
    assert (tmp_path / "compared.png").exists()


def test_the_command_prints_and_writes_the_same(call, fitted, target, tmp_path):
    words = ["evaluate", fitted, "--target", target.images, "--num", 500, "--scenes", 0]  # for those: test_verdict
    labelled = call(*words, "--labels", target.labels, "--json", tmp_path / "new" / "e.json")
    assert labelled.code == 0, labelled.err
    record = json.loads((tmp_path / "new" / "e.json").read_text())
    expected = evaluate(RunFolder.at(fitted), opened(target.images), labels(target.counts), quiet, num=500).record()
    assert record == json.loads(json.dumps(expected))
    measured = record["distances"]["truth"]
    for key in ("number", "classes", "number_wasserstein"):
        assert re.search(rf"{measured['prior'][key]:.3f}\D+{measured['learnt'][key]:.3f}", labelled.out)
    assert record["sources"]["truth"]["mean_number"] == target.counts.sum() / 40
    plain = call(*words)
    assert "truth " not in plain.out.replace("not the truth", "") and "estimate *" in plain.out
    assert "An estimate without labels" in plain.out
    assert call(*words).out == plain.out


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.randoms(use_true_random=False), st.booleans(), st.booleans())
def test_labels_are_read_back_in_any_order_of_rows_and_columns(target, tmp_path, rng, bom, windows):
    images = opened(target.images)
    names = [file.name for file in images.paths]
    write_counts(tmp_path / "c.csv", names, target.counts, CLASSES)
    assert np.array_equal(read_table(tmp_path / "c.csv", CLASSES, images).counts, target.counts)
    head, *rows = [line.split(",") for line in (tmp_path / "c.csv").read_text().splitlines()]
    rng.shuffle(rows)
    order = rng.sample(range(3), 3)
    text = ("\r\n" if windows else "\n").join(",".join(row[i] for i in order) for row in [head, *rows])
    (tmp_path / "d.csv").write_bytes((b"\xef\xbb\xbf" if bom else b"") + text.encode())
    assert np.array_equal(read_table(tmp_path / "d.csv", CLASSES, images).counts, target.counts)


def changed(line: int, text: str | None):
    def change(lines):
        lines[line] = text
        return [x for x in lines if x is not None]

    return change


LABELS = {
    "no class": (lambda lines: [line.split(",")[0] for line in lines], "image,red,blue"),
    "another class": (changed(0, "image,pink,green"), "image,red,blue", "pink, green"),
    "another case": (changed(0, "image,red,Blue"), "'Blue'", "did you mean 'blue'"),
    "no image column": (changed(0, "name,red,blue"), "image,red,blue"),
    "no header": (changed(0, None), "image,red,blue"),
    "nothing": (lambda lines: [], "got none"),
    "short row": (changed(3, "000002.png,1"), "3 fields in line 4", "got 2"),
    "unknown image": (changed(3, "x.png,1,0"), "line 4", "'x.png'"),
    "twice": (changed(3, "000001.png,1,0"), "second one of 000001.png in line 4"),
    "missing": (lambda lines: lines[:-2], "000038.png and 1 more"),
    "negative": (changed(3, "000002.png,1,-2"), "'blue' of 000002.png in line 4", "'-2'"),
    "a half": (changed(3, "000002.png,1.5,2"), "'red' of 000002.png", "'1.5'"),
    "a word": (changed(3, "000002.png,,2"), "'red' of 000002.png", "''"),
    "a number with a gap": (changed(3, "000002.png,1_0,2"), "'red' of 000002.png", "'1_0'"),
    "a huge number": (changed(3, f"000002.png,{10**20},2"), "'red' of 000002.png", "whole number"),
    "a quote": (changed(3, '"000002.png,1,2'), "CSV"),
}


@pytest.mark.parametrize("fault", LABELS)
def test_wrong_labels(fault, call, fitted, target, tmp_path):
    change, *parts = LABELS[fault]
    lines = change(target.labels.read_text().splitlines())
    (tmp_path / "c.csv").write_text("".join(f"{line}\n" for line in lines))
    words = ["--target", target.images, "--labels", tmp_path / "c.csv", "--json", tmp_path / "e.json"]
    result = call("evaluate", fitted, *words)
    assert result.code == 2 and not (tmp_path / "e.json").exists()
    last = result.err.splitlines()[-1]
    assert last.startswith("probscene: expected ")
    assert all(part in last for part in parts), last


def test_labels_that_are_no_text_or_not_there(target, tmp_path):
    images = opened(target.images)
    (tmp_path / "c.csv").write_bytes(b"image,red,blue\n\xff\xfe")
    with pytest.raises(DataError, match="UTF-8"):
        read_table(tmp_path / "c.csv", CLASSES, images)
    for path in (tmp_path, tmp_path / "none.csv"):
        with pytest.raises(DataError, match="expected a file of labels"):
            read_table(path, CLASSES, images)


def test_rows_of_bad_files_are_passed_over(target, tmp_path):
    shutil.copytree(target.images, tmp_path / "images")
    (tmp_path / "images" / "000005.png").write_bytes(b"bad")
    images = ImageFolder(tmp_path / "images", (64, 64), 3, skip_bad=True)
    assert np.array_equal(read_table(target.labels, CLASSES, images).counts, np.delete(target.counts, 5, 0))


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=30))
def test_a_sources_histograms_are_shares(rows):
    source = Source.from_counts(np.array(rows))
    assert source.total.tolist() == [a + b for a, b in rows]
    assert source.number().share.sum() == pytest.approx(1)
    assert source.classes().share.sum() == pytest.approx(1 if any(map(any, rows)) else 0)
    random.Random(0).shuffle(rows)
    assert np.allclose(Source.from_counts(np.array(rows)).number().share, source.number().share)
