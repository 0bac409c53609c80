"""Labels that know some of the classes: only these are compared, as if there were no others."""

import json

import numpy as np
import pytest

from probscene.app.evaluation.labels import read_labels
from probscene.app.evaluation.structure_counts import sample_counts
from probscene.app.fitting.run import RunFolder
from probscene.dataset import ImageFolder
from probscene.errors import DataError
from probscene.inference.statistics.count_metrics import histogram, total_variation

RED, BLUE = 0, 1


@pytest.fixture(params=[RED, BLUE], ids=["red", "blue"])
def labels(request, target, tmp_path):
    """A file that has one class of two, and that class."""
    names = [row.split(",")[0] for row in target.labels.read_text().split()[1:]]
    rows = [f"{name},{count}" for name, count in zip(names, target.counts[:, request.param], strict=True)]
    (tmp_path / "counts.csv").write_text("\n".join([f"image,{('red', 'blue')[request.param]}", *rows, ""]))
    return tmp_path / "counts.csv", request.param


def test_only_what_is_labelled_is_compared(labels, call, fitted, target, tmp_path):
    file, which = labels
    more = ["--json", tmp_path / "e.json"]
    done = call("evaluate", fitted, "--target", target.images, "--labels", file, "--num", 500, "--scenes", 0, *more)
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "e.json").read_text())
    run, name = RunFolder.at(fitted), ("red", "blue")[which]
    assert found["classes"] == [name]
    assert found["sources"]["truth"]["mean_number"] == target.counts[:, which].mean()
    for source, policy in (("prior", run.model.prior), ("learnt", run.guide)):
        counts = sample_counts(run.model, policy, 500, 0).counts[:, which]
        assert found["sources"][source]["mean_number"] == counts.mean()
        expected = total_variation(histogram(counts), histogram(target.counts[:, which]))
        apart = found["distances"]["truth"][source]
        assert apart["number"] == apart["each_class"][name] == pytest.approx(expected)
    assert found["sources"]["estimate"]["each_class"].keys() == {name}


def test_runs_are_compared_by_what_is_labelled(labels, call, fitted, target, tmp_path):
    file, which = labels
    words = ["--labels", file, "--num", 500, "--out", tmp_path / "c.png", "--json", tmp_path / "c.json"]
    done = call("compare", fitted, "--target", target.images, *words)
    assert done.code == 0, done.err
    assert json.loads((tmp_path / "c.json").read_text())["classes"] == [("red", "blue")[which]]


def test_columns_that_are_no_classes_are_refused(labels, fitted, target):
    file, _ = labels
    model = RunFolder.at(fitted).model
    images = ImageFolder(target.images, model.canvas, model.channels)
    assert np.array_equal(read_labels(file, model, images).structures.counts[:, 0], target.counts[:, labels[1]])
    header, *rows = file.read_text().split()
    for columns, part in (
        ("image,green", "red,blue"),
        (f"{header},{header[6:]}", header),
        (f"name,{header[6:]}", "name"),
        ("image", "red,blue"),
    ):
        file.write_text("\n".join([columns, *rows]))
        with pytest.raises(DataError, match=rf"^expected the columns image,.*{part}"):
            read_labels(file, model, images)
