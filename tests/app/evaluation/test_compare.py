"""Runs side by side: the figures are those of evaluate and of plain loops, and the picture shows them."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from probscene.app.evaluation.compare import compare, open_runs
from probscene.app.evaluation.evaluate import evaluate
from probscene.app.evaluation.labels import Labels
from probscene.app.evaluation.structure_counts import StructureCounts, count_structures, sample_counts
from probscene.app.fitting.presets import QUICK
from probscene.app.fitting.run import RunFolder
from probscene.app.views.comparison import picture, picture_rows
from probscene.dataset import ImageFolder
from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.errors import ProbsceneError, RunError

PLATES = Path(__file__).parents[1] / "plates.py"


def quiet(*_):
    pass


@pytest.fixture(scope="module")
def two(call, discs, fitted, target, tmp_path_factory) -> list[Path]:
    """Runs of one model: an LSTM's and a PCFG's."""
    folder = tmp_path_factory.mktemp("two")
    shutil.copytree(fitted, folder / "lstm")
    words = ["--target", target.images, "--out", folder / "pcfg", "--guide", "pcfg"]
    assert call("fit", discs.file, *words, *discs.settings).code == 0
    return [folder / "lstm", folder / "pcfg"]


def untrained(folder: Path, model: str, seed: int, target: str = "images", assets: Path | None = None) -> Path:
    """A run whose guide learnt nothing, and which has seen no image."""
    record = {"config": QUICK.for_renders().to_record(), "target": target, "seed": seed}
    run = RunFolder.create(folder, model, record, assets)
    torch.manual_seed(seed)
    guide = run.new_guide()
    guide.out.bias.data[[k for k, rule in enumerate(run.model.grammar.rules) if not rule.rhs]] += 2.0  # short lists
    run.write_tensors("guide", guide.state_dict())
    return folder


@pytest.fixture(scope="module")
def nested(tmp_path_factory) -> dict[str, RunFolder]:
    folder = tmp_path_factory.mktemp("nested")
    return open_runs([untrained(folder / name, str(PLATES), seed) for seed, name in enumerate("ab")])


def truth_of(run: RunFolder, num: int = 300) -> Labels:
    torch.manual_seed(9)
    derivation, _ = derive_complete(run.model.grammar, run.model.prior, num, run.model.max_steps)
    return Labels(count_structures(run.model, derivation), derivation)


def test_each_run_is_as_far_from_the_truth_as_evaluate_says(two, target):
    images = ImageFolder(target.images, (64, 64), 3)
    labels = Labels(StructureCounts(target.counts, {}))
    runs = open_runs(two)
    for truth, reference in ((labels, "truth"), (None, "estimate")):
        found = compare(runs, images, truth, quiet, num=600)
        assert list(found.sources) == ["prior", "lstm", "pcfg", reference] and found.reference == reference
        for name, run in runs.items():
            alone = evaluate(run, images, truth, quiet, num=600).distances()[reference]
            assert found.distances()[reference][name] == alone["learnt"]
            assert found.distances()[reference]["prior"] == alone["prior"]


def test_rows_are_plain_histograms(two, target):
    labels = Labels(StructureCounts(target.counts, {}))
    found = compare(open_runs(two), ImageFolder(target.images, (64, 64), 3), labels, quiet, num=400)
    rows = {row.label: row for row in found.rows()}
    assert list(rows) == ["objects per image", "red per image", "blue per image"]
    for words, of in {
        "objects per image": lambda counts: counts.sum(1),
        "red per image": lambda counts: counts[:, 0],
        "blue per image": lambda counts: counts[:, 1],
    }.items():
        row, share = rows[words], {}
        for name, source in found.sources.items():
            share[name] = np.bincount(of(source.counts), minlength=20) / len(source.counts)
            assert np.allclose(row.shares[name], share[name][: len(row.shares[name])])
            assert row.means[name] == pytest.approx(of(source.counts).mean())
        assert set(row.total_variation) == {"prior", "lstm", "pcfg"}
        for name, apart in row.total_variation.items():
            assert apart == pytest.approx(np.abs(share[name] - share["truth"]).sum() / 2)


def children_by_rank(derivation: Derivation, grammar, rank: int) -> list[int]:
    """Mugs of the plate of that rank, scene by scene, by a loop over nodes."""
    plate, mug = grammar.kind("plate"), grammar.kind("mug")
    found = []
    for kind, parent in zip(derivation.kind.tolist(), derivation.parent.tolist(), strict=True):
        plates = [i for i, k in enumerate(kind) if k == plate]
        if rank < len(plates):
            found.append(sum(k == mug and p == plates[rank] for k, p in zip(kind, parent, strict=True)))
    return found


def test_where_kinds_nest_children_are_compared_by_rank(nested):
    first = nested["a"]
    truth = truth_of(first)
    found = compare(nested, None, truth, quiet, num=300)
    rows = {row.label: row for row in found.rows()}
    for rank, words in enumerate(("mug per first plate", "mug per second plate")):
        expected = children_by_rank(truth.derivation, first.model.grammar, rank)
        share = np.bincount(expected) / len(expected)
        assert np.allclose(rows[words].shares["truth"][: len(share)], share)
        assert rows[words].means["truth"] == pytest.approx(np.mean(expected))
        assert 0 < rows[words].total_variation["a"] < 1
    structures = sample_counts(first.model, nested["b"].guide, 300, 0)
    assert np.array_equal(found.sources["b"].counts, structures.counts)
    assert set(found.likelihoods) == {"prior", "a", "b"}
    assert found.likelihoods["b"].nats.value == pytest.approx(
        nested["b"].guide.log_prob(truth.derivation).mean().item(), rel=1e-5
    )


def test_without_truth_and_estimate_there_are_means_alone(nested, call, tmp_path):
    found = compare(nested, None, None, quiet, num=200)
    assert found.reference is None and found.distances() == {}
    assert all(not row.total_variation for row in found.rows())
    json.dumps(found.record(), allow_nan=False)
    paths = [run.path for run in nested.values()]
    done = call("compare", *paths, "--out", tmp_path / "c.png", "--num", 200)
    assert done.code == 0, done.err
    assert done.out.startswith("Means")


def test_the_picture_has_a_bar_for_every_share(nested):
    found = compare(nested, None, truth_of(nested["a"]), quiet, num=300)
    rows, names = picture_rows(found), list(found.sources)
    labels = [row.label for row in rows]
    assert labels[:3] == ["objects per image", "mug per image", "plate per image"]
    assert "mug per first plate" in labels and "mug per plate" not in labels
    axes = picture(found).axes
    assert len(axes) == len(rows) * len(names)
    for i, row in enumerate(rows):
        for j, name in enumerate(names):
            cell = axes[i * len(names) + j]
            heights = [bar.get_height() for container in cell.containers for bar in container]
            share = row.shares.get(name, np.zeros(0))
            assert np.allclose(heights, share[: len(heights)]) and share[len(heights) :].sum() < 0.05
            if name in row.total_variation:
                assert f"TV {row.total_variation[name]:.3f}" in cell.get_title(loc="right")
    assert [text.get_text() for cell in axes[: len(names)] for text in cell.texts] == names


def test_many_classes_share_one_row(tmp_path):
    runs = open_runs([untrained(tmp_path / "run", "multi_mnist", 0)])
    found = compare(runs, None, truth_of(runs["run"], 100), quiet, num=100)
    assert [row.label for row in picture_rows(found)] == ["objects per image", "class of an object"]
    (_, row), ticks = picture_rows(found), picture(found).axes[-1].get_xticklabels()
    assert row.shares["truth"].sum() == pytest.approx(1) and [t.get_text() for t in ticks] == list("0123456789")
    assert len(found.rows()) == 1 + 10


def test_the_command_draws_prints_and_writes_the_same(call, two, target, tmp_path):
    out = tmp_path / "new" / "c.png"
    words = ["compare", *two, "--target", target.images, "--labels", target.labels, "--num", 500, "--out", out]
    done = call(*words, "--json", tmp_path / "new" / "c.json")
    assert done.code == 0, done.err
    images, labels = ImageFolder(target.images, (64, 64), 3), Labels(StructureCounts(target.counts, {}))
    expected = compare(open_runs(two), images, labels, quiet, num=500)
    record = json.loads((tmp_path / "new" / "c.json").read_text())
    assert record == json.loads(json.dumps(expected.record()))
    assert record["runs"]["pcfg"]["guide"] == {"kind": "pcfg"} and record["reference"] == "truth"
    for row in expected.rows():
        figures = (
            (row.total_variation[name], row.wasserstein[name], row.means[name]) for name in ("prior", "lstm", "pcfg")
        )
        cells = r"\D+".join(f"{apart:.3f} {moved:.3f} \\({mean:.2f}\\)" for apart, moved, mean in figures)
        assert re.search(rf"{row.label}\D+{cells}", done.out), row.label
    assert "TV and W-1 to the truth" in done.out and "…" not in done.out
    first = out.read_bytes()
    with Image.open(out) as drawn:
        assert drawn.format == "PNG" and drawn.width > drawn.height
    call(*words)
    assert out.read_bytes() == first


def test_the_runs_own_target_is_taken_where_none_is_named(call, two, target, tmp_path):
    done = call("compare", *two, "--num", 100, "--out", tmp_path / "c.png")
    assert done.code == 0 and "what the feature network reads" in done.out and "An estimate without labels" in done.out
    done = call("compare", *two, "--labels", target.labels, "--num", 100, "--out", tmp_path / "c.png")
    assert done.code == 0 and "TV and W-1 to the truth" in done.out


def test_assets_may_lie_in_several_places_if_they_are_the_same(tmp_path, inked):
    model = tmp_path / "inked.py"
    model.write_text(PLATES.read_text() + inked)
    runs = []
    for name, ink in (("a", "blue"), ("b", "blue"), ("c", "red")):
        (tmp_path / "inks" / name).mkdir(parents=True)
        (tmp_path / "inks" / name / "ink").write_text(ink)
        runs.append(untrained(tmp_path / name, str(model), 0, assets=tmp_path / "inks" / name))
    assert list(open_runs(runs[:2])) == ["a", "b"]
    with pytest.raises(RunError, match=f"{runs[2]} of {model} with other assets"):
        open_runs(runs)


def test_what_cannot_be_compared(call, two, nested, target, tmp_path):
    lstm, pcfg = two
    out = ["--out", tmp_path / "c.png", "--num", 50]
    shutil.copytree(lstm, tmp_path / "prior")
    shutil.copytree(lstm, tmp_path / "more" / "lstm")
    shutil.copytree(lstm, tmp_path / "unfinished")
    (tmp_path / "unfinished" / "guide.safetensors").unlink()
    elsewhere = shutil.copytree(pcfg, tmp_path / "elsewhere")
    record = json.loads((elsewhere / "run.json").read_text())
    (elsewhere / "run.json").write_text(json.dumps(record | {"target": "other"}))
    for paths, *parts in (
        ([lstm, nested["a"].path], "expected runs of one model", "discs.py", "plates.py"),
        ([lstm, tmp_path / "more" / "lstm"], "different names", "another 'lstm'"),
        ([tmp_path / "prior"], "none of them prior"),
        ([lstm, tmp_path / "unfinished"], "expected a finished fit", "--resume"),
        ([lstm, tmp_path / "none"], "expected a run folder"),
        ([lstm, elsewhere], "fitted to the same images", "--target"),
    ):
        done = call("compare", *paths, *out)
        last = done.err.splitlines()[-1]
        assert done.code == 2 and last.startswith("probscene: expected"), done.err
        assert all(part in last for part in parts), last
    done = call("compare", lstm, "--out", tmp_path)
    assert done.code == 2 and "name a file in it" in done.err
    assert not (tmp_path / "c.png").exists()
    assert call("compare", lstm, elsewhere, "--target", target.images, *out).code == 0
    with pytest.raises(ProbsceneError, match="positive number of scenes"):
        compare(open_runs([lstm]), None, None, quiet, num=0)
    with pytest.raises(RunError, match="another file"):
        changed = json.loads((pcfg / "run.json").read_text()) | {"model_sha256": "0"}
        (elsewhere / "run.json").write_text(json.dumps(changed))
        open_runs([lstm, elsewhere])
