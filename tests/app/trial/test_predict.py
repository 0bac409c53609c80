"""What detectors find in photographs: that others read it, that its scores are those that are said, what is refused."""

import contextlib
import io
import json
import shutil

import numpy as np
import pytest
from faster_coco_eval import COCO
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import probscene as ps
from probscene.app.detectors.folder import DEFAULT_MIN_SCORE, RECORD, WEIGHTS
from probscene.app.detectors.predict import uncertainty
from probscene.app.detectors.scores import fewest_errors
from probscene.app.labels.reading import read_annotations
from probscene.app.trial.bootstrap import draw
from probscene.app.trial.results import precisions
from probscene.app.trial.scoring import Matched
from probscene.app.trial.sets import read_set
from probscene.app.trial.training import Detections
from probscene.decoding import read_rgb
from probscene.errors import DataError, ProbsceneError


def predict(*words, **options):
    return ps.predict(*words, **options, progress=False)


@pytest.fixture(scope="module")
def images(photographs):
    return photographs / "test" / "images"


@pytest.fixture(scope="module")
def predicted(trained, images, tmp_path_factory):
    """All that was found, in COCO's file."""
    out = tmp_path_factory.mktemp("predicted") / "predicted.json"
    return predict(trained, images, out, min_score=0.0)


def test_coco_reads_it_as_labels_and_as_results(predicted, photographs):
    with contextlib.redirect_stdout(io.StringIO()):
        own = COCO(str(predicted.path))
        truth = COCO(str(photographs / "test" / "annotations.json"))
        results = truth.loadRes([dict(each, image_id=each["image_id"] - 1) for each in own.dataset["annotations"]])
    number = sum(len(each.scores) for each in predicted.found)
    assert len(own.getAnnIds()) == len(results.getAnnIds()) == number > 0
    assert [each["file_name"] for each in own.dataset["images"]] == list(predicted.images)


def test_labels_read_back_are_what_was_found(predicted, trained, images, tmp_path):
    predict(trained, images, tmp_path / "yolo", "yolo", min_score=0.0)
    for path, names in ((predicted.path, predicted.images), (tmp_path / "yolo", None)):
        labels = read_annotations(path)
        assert set(labels.classes) == {"red", "blue"}
        for i, entry in enumerate(labels.images):
            assert names is None or entry.name == names[i]
            found, objects = predicted.found[i], labels.read(i, (64, 64))
            assert [one.name for one in objects] == [predicted.classes[c] for c in found.classes]
            boxes = np.array([[one.left, one.top, one.right, one.bottom] for one in objects]).reshape(-1, 4)
            np.testing.assert_allclose(boxes, found.boxes, atol=1e-4)
    assert len(read_set(predicted.path, photographs=images).examples) == 6


def test_scores_are_those_of_what_is_predicted(predicted, trained, photographs):
    tested = read_set(photographs / "test", trained.classes)
    record, found = json.loads(predicted.path.read_text()), []
    for image in record["images"]:
        own = [each for each in record["annotations"] if each["image_id"] == image["id"]]
        x, y, width, height = np.array([each["bbox"] for each in own]).reshape(-1, 4).T
        classes = np.array([each["category_id"] - 1 for each in own])
        score = np.array([each["score"] for each in own], np.float32)
        found.append(Detections(np.stack([x, y, x + width, y + height], 1).astype(np.float32), classes, score))
    each = precisions(tested, [found], draw(len(found), 1, 0, 0))
    said = trained.record["scores"]["precision"]
    for (name, measure), value in each.items():
        assert said[measure][name]["value"] == pytest.approx(value[0, 0], abs=1e-4)


@given(
    st.lists(st.tuples(st.integers(0, 9), st.booleans()), min_size=1, max_size=30), st.integers(0, 5), st.integers(1, 3)
)
def test_no_other_least_score_makes_fewer_errors(detections, missed, classes):
    score = np.array([value / 10 for value, _ in detections], np.float32)
    correct = np.array([right for _, right in detections])
    objects = int(correct.sum()) + missed

    def errors(least: float) -> int:
        kept = score >= np.float32(least)
        return int((kept & ~correct).sum() + objects - (kept & correct).sum())

    parts = np.arange(len(score)) % classes
    matched = []
    for c in range(classes):
        mine = np.flatnonzero(parts == c)
        mine = mine[np.argsort(-score[mine], kind="stable")]
        own = int(correct[mine].sum()) + (missed if c == 0 else 0)
        matched.append(Matched(np.zeros(len(mine), np.int64), correct[mine], score[mine], np.array([own])))
    least, number = fewest_errors(matched)
    assert errors(least) == number == min(errors(value) for value in set(score.tolist()))


def test_the_least_score_is_that_of_fewest_errors(trained, images, predicted, tmp_path):
    found = predict(trained, images, tmp_path / "some.json")
    assert found.min_score == trained.min_score and "fewest errors on 6 held-out photographs" in found.reason
    for some, every in zip(found.found, predicted.found, strict=True):
        keep = every.scores >= trained.min_score
        np.testing.assert_array_equal(some.boxes, every.boxes[keep])
    with_none = type(trained)(trained.path, {**trained.record, "scores": None})
    assert predict(with_none, images, tmp_path / "some.json").min_score == DEFAULT_MIN_SCORE


def test_what_is_worth_labelling_next_was_not_labelled(trained, images, photographs, tmp_path):
    """Those that the detector is least sure of, of others than it was trained or tested on."""
    (tmp_path / "photos").mkdir()
    for name, image in (("near.png", "000.png"), ("far.png", "001.png")):
        turned = Image.open(images / image).transpose(Image.Transpose.ROTATE_180)
        turned.save(tmp_path / "photos" / name)
    shutil.copy(photographs / "train" / "images" / "003.png", tmp_path / "photos")
    shutil.copy(images / "004.png", tmp_path / "photos" / "tested.png")
    found = predict(trained, tmp_path / "photos", tmp_path / "p.json", overlays=tmp_path / "drawn")
    assert set(found.label_next) == {"near.png", "far.png"}
    everything = predict(trained, tmp_path / "photos", tmp_path / "p.json", min_score=0.0)
    unsure = dict(zip(everything.images, (uncertainty(each.scores) for each in everything.found), strict=True))
    assert unsure[found.label_next[0]] >= unsure[found.label_next[1]]
    assert (tmp_path / "drawn" / "label_next.txt").read_text().split() == list(found.label_next)
    names = {path.name for path in (tmp_path / "drawn").iterdir()}
    assert names == {"near.png", "far.png", "003.png", "tested.png", "label_next.txt"}


@given(st.lists(st.floats(0, 1, width=32), max_size=5))
def test_a_detection_counts_most_in_the_middle(scores):
    found = uncertainty(np.array(scores, np.float32))
    assert 0 <= found <= len(scores) and uncertainty(np.array([*scores, 0.5], np.float32)) == pytest.approx(found + 1)


def test_the_command_line_and_the_call_give_the_same_bytes(trained, images, predicted, tmp_path, call):
    words = ["--min-score", "0", "--overlays", tmp_path / "drawn"]
    done = call("predict", trained.path, images, "--out", tmp_path / "one.json", *words)
    assert done.code == 0, done.err
    assert (tmp_path / "one.json").read_bytes() == predicted.path.read_bytes()
    assert "6 photographs" in done.out and "Detecting: 6 images" in done.err and "as given" in done.out
    assert {read_rgb(file).shape for file in (tmp_path / "drawn").glob("*.png")} == {(640, 640, 3)}


def test_photographs_of_several_folders_have_them_in_their_names(trained, photographs, predicted, tmp_path):
    paths = [photographs / "test" / "images", photographs / "train" / "images" / "000.png"]
    found = predict(trained, paths, tmp_path / "all.json", min_score=0.0)
    assert found.images[-1] == "train/images/000.png" and found.images[0] == "test/images/000.png"
    np.testing.assert_array_equal(found.found[0].boxes, predicted.found[0].boxes)
    predict(trained, paths, tmp_path / "all", "yolo")
    assert (tmp_path / "all" / "labels" / "train" / "images" / "000.txt").is_file()
    with pytest.raises(ProbsceneError, match="another folder for overlays"):
        predict(trained, paths, tmp_path / "all.json", overlays=photographs)


def test_bad_files_are_named_or_left_out(trained, images, tmp_path):
    shutil.copytree(images, tmp_path / "photos")
    (tmp_path / "photos" / "002.png").write_bytes(b"none")
    with pytest.raises(DataError, match=r"got 1 of 6 bad: 002\.png .*--skip-bad"):
        predict(trained, tmp_path / "photos", tmp_path / "out.json")
    assert not (tmp_path / "out.json").exists()
    assert len(predict(trained, tmp_path / "photos", tmp_path / "out.json", skip_bad=True).images) == 5


def damaged(trained, folder, name, how):
    shutil.copytree(trained.path, folder)
    how(folder / name)
    return folder


def test_what_cannot_be_done_is_one_line(trained, images, tmp_path, call):
    (tmp_path / "empty").mkdir()
    cut = damaged(trained, tmp_path / "cut", WEIGHTS, lambda file: file.write_bytes(file.read_bytes()[:5000]))
    gone = damaged(trained, tmp_path / "gone", WEIGHTS, lambda file: file.unlink())
    torn = damaged(trained, tmp_path / "torn", RECORD, lambda file: file.write_text('{"format": 1}'))
    later = damaged(trained, tmp_path / "later", RECORD, lambda file: file.write_text('{"format": 9}'))
    out = tmp_path / "out.json"
    for words, said in (
        ([tmp_path / "empty", images, "--out", out], "got no detector.json"),
        ([tmp_path / "none", images, "--out", out], "got no detector.json"),
        ([cut, images, "--out", out], "or a damaged file"),
        ([gone, images, "--out", out], "detector.safetensors, got none"),
        ([torn, images, "--out", out], "got a damaged file"),
        ([later, images, "--out", out], "format 1"),
        ([trained.path, tmp_path / "empty", "--out", out], "an empty folder"),
        ([trained.path, tmp_path / "nowhere", "--out", out], "which is not there"),
        ([trained.path, images, "--out", tmp_path / "empty"], "got the folder"),
        ([trained.path, images, "--out", images / "000.png"], "got the photograph"),
        ([trained.path, images, "--out", tmp_path, "--format", "yolo"], "new or empty folder"),
        ([trained.path, images, "--out", out, "--format", "voc"], "coco or yolo"),
        ([trained.path, images, "--out", out, "--min-score", "2"], "from 0 to 1"),
        ([trained.path, images, "--out", out, "--overlays", images], "another folder for overlays"),
    ):
        done = call("predict", *words)
        (line,) = [line for line in done.err.splitlines() if line.startswith("probscene: ")]
        assert done.code == 2 and said in line, (words, done.err)
    assert not out.exists()


def test_yolo_needs_names_that_differ_without_ending(trained, images, tmp_path):
    Image.open(images / "000.png").save(tmp_path / "000.jpg")
    with pytest.raises(DataError, match="different names for YOLO"):
        shutil.copy(images / "000.png", tmp_path)
        predict(trained, tmp_path, tmp_path / "out", "yolo")
    with pytest.raises(ProbsceneError, match="empty list"):
        predict(trained, [], tmp_path / "out.json")
