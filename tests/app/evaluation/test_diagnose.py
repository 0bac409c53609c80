"""The verdict on real renders: right where one knows it, held against labels, shown by both commands."""

import html
import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation import diagnose as verdict
from probscene.app.evaluation.diagnose import diagnose
from probscene.app.evaluation.evaluate import evaluate
from probscene.app.evaluation.explain import structure_reason
from probscene.app.evaluation.label_agreement import DISAGREE, agreement
from probscene.app.evaluation.labels import counts_of_dataset, read_labels
from probscene.app.evaluation.sources import Source
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.counts import write_counts
from probscene.app.loading import load_model
from probscene.dataset import ImageFolder
from probscene.errors import DataError, ProbsceneError
from probscene.inference.statistics.residual import Grade, worst_grade
from probscene.inference.statistics.verdict import Verdict
from probscene.structure import StructurePrior, counts, weights

IMAGES, SCENES = 200, 300


def quiet(*_):
    pass


class Guided(RunFolder):
    """A run whose guide is any policy."""

    policy = None

    @property
    def guide(self):
        return self.policy or super().guide


@pytest.fixture(scope="module")
def drawn(tmp_path_factory, discs):
    """Folders of images: of the truth, with more discs than anything here makes, and of another domain."""
    folder, model = tmp_path_factory.mktemp("drawn"), load_model(str(discs.file))

    def images(name, of, policy):
        generate_scenes(of, policy, IMAGES, folder / name, format="images")
        return ImageFolder(folder / name / "images", model.canvas, 3)

    truth, elsewhere = model.target(0), load_model("aerial2d")
    crowd = structure(model, (0, 0, 0, 0, 0, 1), (1, 1))
    target = images("target", truth, truth.prior)
    write_counts(folder / "counts.csv", *counts_of_dataset(truth, folder / "target"), truth.classes)
    return SimpleNamespace(
        target=target,
        labels=folder / "counts.csv",
        crowd=images("crowd", model, crowd),
        aerial=images("aerial", elsewhere, elsewhere.prior),
    )


@pytest.fixture(scope="module")
def words(discs):
    """Of a short fit by features that need no training."""
    features = f"{Path(__file__).with_name('colours.py')}:ColourFeatures"
    return [*discs.without("features", "parameters"), "--learn", "structure", "--features", features]


@pytest.fixture(scope="module")
def seeing(call, drawn, discs, words, tmp_path_factory):
    """A run whose features tell five discs from three; those of the one that all tests share do not."""
    out = tmp_path_factory.mktemp("seeing") / "run"
    done = call("fit", discs.file, "--target", drawn.target.path, "--out", out, *words)
    assert done.code == 0 and "Verdict" not in done.out, done.err
    return out


def structure(model, number, colour) -> StructurePrior:
    return StructurePrior(model.grammar, Discs=counts(*number), Disc=weights(*colour))


def guided(path, policy) -> Guided:
    run = Guided.at(path)
    run.policy = policy(run.model)
    return run


CASES = {
    "a good fit": (lambda m: m.target(0).prior, "target", Verdict.GOOD),
    "the prior": (lambda m: m.prior, "target", Verdict.NOT_FITTED),
    "one mode": (lambda m: structure(m, (0, 1), (4, 1)), "target", Verdict.MODE_COLLAPSE),
    "more than can be made": (lambda m: structure(m, (0, 0, 0, 1), (1, 1)), "crowd", Verdict.OUT_OF_SUPPORT),
    "another domain": (lambda m: m.target(0).prior, "aerial", Verdict.DOMAIN_SHIFT),
}


@pytest.mark.parametrize("case", CASES)
def test_the_verdict_on_renders_is_right(case, seeing, drawn):
    policy, folder, expected = CASES[case]
    target = getattr(drawn, folder)
    told = []
    found = diagnose(guided(seeing, policy), target, lambda *said: told.append(said), SCENES)
    assert found.structure.verdict == expected, structure_reason(found.structure)
    assert told[-1][0] == "judging" and told[-1][1] == told[-1][2]
    assert len(found.real_uncovered) == len(found.generated_uncovered) == verdict.NUM_EXAMPLES
    assert found.names == tuple(target.paths[i].name for i in found.real_uncovered)
    assert all(picture.shape == (64, 64, 3) for picture in found.generated_uncovered)
    record = json.loads(json.dumps(found.record(), allow_nan=False))
    assert record["parts"]["structure"]["verdict"] == str(expected) and "labels" not in record
    # Discs stand and look as the prior's, which few images can tell from the target's: the structure is not the whole.
    whole = "not judged" if expected is Verdict.GOOD else str(expected)
    assert record["verdict"] == whole and record["overall"] != "good"
    assert set(record["single_features"]) == {"red", "blue"}


def test_the_same_run_has_the_same_verdict(seeing, drawn):
    run = RunFolder.at(seeing)
    one, other = (diagnose(run, drawn.target, quiet, 100) for _ in range(2))
    assert one.record() == other.record()
    assert all(np.array_equal(a, b) for a, b in zip(one.generated_uncovered, other.generated_uncovered, strict=True))


@pytest.mark.parametrize(("some", "close"), [(True, True), (False, False)])
def test_labels_say_whether_the_verdict_was_right(some, close, seeing, drawn, tmp_path):
    lines = drawn.labels.read_text().splitlines()
    (tmp_path / "c.csv").write_text("\n".join(lines[:61] if some else lines))
    model = load_model(RunFolder.at(seeing).record["model"])
    labels = read_labels(tmp_path / "c.csv", model, drawn.target, some)
    assert len(labels.structures) == (60 if some else IMAGES)
    run = guided(seeing, lambda m: m.target(0).prior if close else m.prior)
    found = diagnose(run, drawn.target, quiet, SCENES, evaluate(run, drawn.target, labels, quiet, 2000))
    assert found.agreement.close == close and found.agreement.agrees(found.structure.verdict)
    record = json.loads(json.dumps(found.record(), allow_nan=False))["labels"]
    assert record["agree"] and record["because"].startswith("The labels agree")
    assert record["images"] == len(labels.structures)
    assert set(record["each"]) == {"number of objects", "red", "blue"}


def test_labels_disagree_where_the_network_counts_wrongly():
    rng = np.random.default_rng(0)
    truth = Source.from_counts(rng.multinomial(6, [0.5, 0.5], 300))
    same, other = (
        Source.from_counts(rng.multinomial(6, [0.5, 0.5], 5000)),
        Source.from_counts(rng.multinomial(6, [0.8, 0.2], 5000)),
    )
    right, wrong = (agreement(side, truth, ("a", "b"), "label ten images") for side in (same, other))
    assert right.close and right.agrees(Verdict.GOOD) and not right.agrees(Verdict.UNDERFIT)
    assert not wrong.close and wrong.agrees(Verdict.UNDERFIT) and not wrong.agrees(Verdict.GOOD)
    said = wrong.sentence(Verdict.GOOD)
    assert "Counted wrongly in the images: a, b. Label ten images" in said and "train" not in said
    assert "only the features of the images differ" in right.sentence(Verdict.UNDERFIT)
    assert wrong.worst != "number of objects"  # that is always six


@given(st.sampled_from(Grade), st.sampled_from(Grade), st.sampled_from(Grade), st.booleans())
def test_what_the_labels_disagree_with_is_nowhere_good(structure, layout, counts, close):
    """And what they do not disagree with stays as it is."""
    rng = np.random.default_rng(0)
    truth = Source.from_counts(rng.poisson([2, 4], (300, 2)))
    learnt = Source.from_counts(rng.poisson([2 if close else 4, 4], (3000, 2)))
    found = agreement(learnt, truth, ("a", "b"), "label ten images")
    parts = {"structure": structure, "layout": layout}
    overall = worst_grade(parts.values())
    record = {"overall": str(overall), "verdict": str(overall), "because": "", "remedy": ""}
    record |= {"parts": {name: {"word": str(word)} for name, word in parts.items()}}
    record |= {"classes": {name: {"counts": str(counts), "layout": "good"} for name in "ab"}}
    said = found.corrected(record)
    assert said["parts"]["layout"] == record["parts"]["layout"] and said["classes"]["b"] == record["classes"]["b"]
    assert found.close is close and (said == record or not close)
    if not close:
        assert found.wrong == ("number of objects", "a")
        words = said["overall"], said["verdict"], said["parts"]["structure"]["word"], said["classes"]["a"]["counts"]
        assert "good" not in words and (said["verdict"] == DISAGREE) is (structure is Grade.GOOD)
        assert said["overall"] == str(worst_grade([overall, Grade.BETTER]))


def test_labels_of_one_distribution_rarely_disagree():
    rng = np.random.default_rng(0)
    close = 0
    for seed in range(40):
        truth, learnt = (Source.from_counts(rng.poisson([2, 0.3, 5], (n, 3))) for n in (120, 3000))
        close += agreement(learnt, truth, ("a", "b", "c"), "", seed).close
    assert close >= 38


def test_both_commands_say_it(call, seeing, drawn, tmp_path):
    words = ["evaluate", seeing, "--target", drawn.target.path, "--num", 300, "--scenes", 120]
    done = call(*words, "--labels", drawn.labels, "--json", tmp_path / "e.json")
    assert done.code == 0, done.err
    record = json.loads((tmp_path / "e.json").read_text())["trust"]
    assert done.out.startswith(f"Verdict: {record['verdict']}.\n{record['because']}\n{record['remedy']}\n")
    assert record["labels"]["because"] in done.out and record["unlike_images"][0] in done.out
    done = call("report", seeing, "--out", tmp_path / "r.html", "--num", 300, "--scenes", 120)
    assert done.code == 0, done.err
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    before, after = page.split("<details>", 1)
    (said,) = re.findall(r'<p class="verdict"><b>([^<]+)</b>: ([^<]+)</p>', before)
    assert all(said) and before.index("Target: some") < before.index(said[0]) < before.index("<h2>Histograms")
    assert "Verdict by parts" in after and "Target images least like any generated scene: 000" in after


def test_a_fit_ends_with_its_verdict_which_is_that_of_every_command_on_its_images(call, drawn, discs, words, tmp_path):
    words = [word for word in words if word != "--no-verdict"]
    done = call("fit", discs.file, "--target", drawn.target.path, "--out", tmp_path / "run", *words)
    assert done.code == 0, done.err
    assert re.match(r"Verdict: [\w ]+\.\n", done.out) and "\nNext: " in done.out
    for part in ("structure", "layout", "looks"):
        assert re.search(rf"│ {part} +│", done.out)
    said = done.out[: done.out.index("\nNext: ")]
    assert "Judged by the 200 images that it was fitted to, 60 scenes of the fit" in said
    evaluated = call("evaluate", tmp_path / "run", "--target", drawn.target.path, "--num", 100)
    shown = call("report", tmp_path / "run", "--num", 100, "--out", tmp_path / "r.html")
    assert evaluated.out.startswith(said) and shown.code == 0
    page = html.unescape((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert all(cell in page for cell in re.findall(r"\d+\.\d+", said)) and said.split("\n")[1] in page
    others = call("evaluate", tmp_path / "run", "--target", drawn.crowd.path, "--num", 100, "--scenes", 50)
    assert "Judged by 200 images that it was not fitted to, in " in others.out and "50 scenes of the fit" in others.out
    again = call("fit", "--resume", "--out", tmp_path / "run")
    assert again.code == 0 and "Verdict" not in again.out  # it was finished


def test_too_few_images_have_no_verdict_and_are_still_compared(call, seeing, drawn, tmp_path):
    (tmp_path / "few").mkdir()
    for path in drawn.target.paths[:12]:
        (tmp_path / "few" / path.name).write_bytes(path.read_bytes())
    done = call("evaluate", seeing, "--target", tmp_path / "few", "--num", 100, "--json", tmp_path / "e.json")
    assert done.code == 0 and "No verdict. expected at least 40 real images for a verdict, got 12" in done.out
    assert json.loads((tmp_path / "e.json").read_text())["trust"]["verdict"] is None


def test_images_that_are_all_the_same_have_no_verdict(seeing, drawn, tmp_path):
    for i in range(40):
        (tmp_path / f"{i}.png").write_bytes(drawn.target.paths[0].read_bytes())
    found = diagnose(RunFolder.at(seeing), ImageFolder(tmp_path, (64, 64), 3), quiet, 64)
    assert found.structure is None and "identical" in found.absent


def test_wrong_numbers_and_no_labels_at_all(call, seeing, drawn, tmp_path):
    with pytest.raises(ProbsceneError, match="at least 40 scenes to judge by, got 39"):
        diagnose(RunFolder.at(seeing), drawn.target, quiet, 39)
    (tmp_path / "c.csv").write_text("image,red,blue\n")
    with pytest.raises(DataError, match="expected labels of images .* got none"):
        read_labels(tmp_path / "c.csv", load_model(RunFolder.at(seeing).record["model"]), drawn.target, some=True)
    short = "\n".join(drawn.labels.read_text().splitlines()[:20])
    (tmp_path / "c.csv").write_text(short)
    words = ["evaluate", seeing, "--target", drawn.target.path, "--num", 100, "--scenes", 0]
    refused = call(*words, "--labels", tmp_path / "c.csv")
    assert refused.code == 2 and "--some-labels" in refused.err
    assert call(*words, "--labels", tmp_path / "c.csv", "--some-labels").code == 0
