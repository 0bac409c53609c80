"""That detectors learn, and that trainings are the same bytes in any process."""

import json
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import safetensors.torch
import torch
from second_device import SECOND, second_device
from torchvision.models import resnet50

import probscene as ps
from probscene.app.detectors.train import TrainOptions
from probscene.app.trial.detector import RECIPES, build
from probscene.app.trial.sets import read_set
from probscene.app.trial.training import Pictures, Stage, augmented, detect, draw_augmentation, fitted, order, train
from probscene.app.trial.trial import TrainingBudget, TrialOptions, trial
from probscene.decoding import read_rgb
from probscene.errors import DataError, RunError

SMALL = {"budget": TrainingBudget(iterations=2), "seeds": 2, "resamples": 20, "size": (64, 64)}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_detector_learns_what_is_drawn(drawn, tmp_path):
    found = ps.trial(
        drawn / "test", tmp_path / "out", {"drawn": drawn / "train"},
        TrialOptions(seeds=1, resamples=50, size=(64, 64), budget=TrainingBudget(iterations=50)), progress=False,
    )  # fmt: skip
    assert found.precision("drawn").value > 0.6
    record = json.loads((tmp_path / "out" / "results.json").read_text())
    figure = record["rows"]["drawn"]["precision"]["AP50"]["mean"]
    assert figure["low"] <= figure["value"] <= figure["high"]
    assert record["rows"]["drawn"]["coco"]["AP50"] == pytest.approx(figure["value"], abs=1e-6)


def test_two_workers_give_the_same_bytes(drawn, tmp_path, ready_workers):
    for workers in (1, 2):
        sets, options = {"two": f"{drawn / 'train'}:2"}, TrialOptions(**SMALL)
        trial(drawn / "test", tmp_path / str(workers), sets, options, workers=workers)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_mask_rcnn_is_trained_from_the_weights_of_a_user(drawn, tmp_path):
    file = tmp_path / "resnet50.safetensors"
    safetensors.torch.save_file(resnet50(weights=None).state_dict(), file)
    detector, examples = build(f"maskrcnn={file}", 2, (64, 64)), read_set(drawn / "train").examples
    frozen = detector.backbone.body.layer1[0].conv1.weight.clone()
    recipe = RECIPES["maskrcnn"]
    train(detector, [Stage((examples[:2],), 2)], recipe, (64, 64), (0,))
    found = detect(detector, examples[0].path, (64, 64), recipe.first_label)
    again = build("maskrcnn", 2, (64, 64))  # without the file, for the trained weights
    again.load_state_dict(detector.state_dict())
    assert (detect(again, examples[0].path, (64, 64), recipe.first_label).boxes == found.boxes).all()
    assert set(found.classes.tolist()) <= {0, 1} and (frozen == detector.backbone.body.layer1[0].conv1.weight).all()
    safetensors.torch.save_file({"x": torch.zeros(1)}, file)
    with pytest.raises(DataError, match="maskrcnn_resnet50_fpn or resnet50"):
        build(f"maskrcnn={file}", 2, (64, 64))


def test_boxes_go_with_the_image(drawn):
    """What is drawn stands inside its box, however the image is mirrored, moved and scaled."""
    pictures, random, right = Pictures((96, 128)), np.random.default_rng(0), []
    for example in read_set(drawn / "train").examples:
        for _ in range(5):
            image, boxes, classes = augmented(example, pictures, draw_augmentation(random))
            assert image.shape == (96, 128, 3) and len(boxes) == len(classes) <= len(example.boxes)
            for (x0, y0, x1, y1), c in zip(boxes, classes, strict=True):
                green = image[int((y0 + y1) / 2), int((x0 + x1) / 2), 1]
                right.append((green > 140) if c == 0 else (green < 60))  # discs are light, squares dark
    assert np.mean(right) > 0.85  # the rest are covered by others


def test_an_image_keeps_its_shape_in_a_frame_of_another(drawn):
    image = read_rgb(read_set(drawn / "train").examples[0].path)[:40]
    frame, scale = fitted(image, (64, 128))
    assert frame.shape == (64, 128, 3) and scale == pytest.approx(1.6)
    assert (frame[:, 103:] == 127).all() and frame[:, :102].std() > 1


def test_parts_are_shown_in_turn_and_all_of_each():
    shown = list(order((tuple("abc"), tuple("XY")), 12, np.random.default_rng(0)))
    assert "".join(shown[1::2]).isupper() and sorted(shown[0::2]) == sorted("abc" * 2)
    assert sorted(shown[1::2]) == sorted("XY" * 3)


def test_weights_after_fine_tuning_are_averaged_with_those_before(drawn):
    examples, recipe, states = read_set(drawn / "train").examples, RECIPES["efficientnet"], []
    torch.manual_seed(0)
    detector = build("efficientnet", 2, (64, 64))
    initial = {key: value.clone() for key, value in detector.state_dict().items()}
    for averages in (False, True):
        detector.load_state_dict(initial)
        train(detector, [Stage((examples[:4],), 8, averages_weights=averages)], recipe, (64, 64), (0,))
        states.append({key: value.clone() for key, value in detector.state_dict().items()})
    tuned, averaged = states
    assert any((tuned[key] != initial[key]).any() for key in tuned)
    for key, value in averaged.items():
        assert torch.allclose(value, ((initial[key] + tuned[key]) / 2).to(value.dtype), atol=1e-6)


def test_a_detector_on_another_device_has_the_bytes_of_one_on_the_cpu(drawn, monkeypatch):
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda groups, fused: adam(groups))  # torch fuses on devices that it knows
    examples, recipe, found = read_set(drawn / "train").examples, RECIPES["efficientnet"], []
    for device in (torch.device("cpu"), SECOND):
        with second_device():
            torch.manual_seed(0)
            detector = build("efficientnet", 2, (64, 64)).to(device)
            train(detector, [Stage((examples[:4],), 8)], recipe, (64, 64), (0,))
            found.append(detect(detector, examples[0].path, (64, 64), recipe.first_label))
    assert len(found[0].scores) and all((one == other).all() for one, other in zip(*found, strict=True))


def test_trials_and_kept_detectors_on_another_device_are_those_of_the_cpu(drawn, discs, tmp_path, monkeypatch):
    adam, word = torch.optim.Adam, str(SECOND)
    monkeypatch.setattr(torch.optim, "Adam", lambda groups, fused: adam(groups))
    for module in ("trial.trial", "detectors.train", "detectors.folder"):
        monkeypatch.setattr(f"probscene.app.{module}.chosen_device", torch.device)
    image, seen = read_rgb(next((drawn / "test" / "images").glob("*.png"))), []
    for device in ("cpu", word):
        budget = TrainingBudget(iterations=2, device=device)
        with second_device():
            options = TrialOptions(seeds=1, resamples=20, size=(64, 64), budget=budget)
            trial(drawn / "test", tmp_path / f"trial-{device}", {"two": f"{drawn / 'train'}:2"}, options)
            options = TrainOptions(generate=4, size=(64, 64), budget=budget)
            trained = ps.train(discs.file, None, None, tmp_path / device, options, progress=False)
            found = trained(image), ps.predict(trained, drawn / "test" / "images", tmp_path / f"{device}.json").found[0]
        assert trained.record["device"] == device == trained.device
        seen.append([*found[0], *found[1]])
    assert all((one == other).all() for one, other in zip(*seen, strict=True))
    for name in (f"trainings/{file.name}" for file in (tmp_path / "trial-cpu" / "trainings").iterdir()):
        one, other = (safetensors.numpy.load_file(tmp_path / f"trial-{device}" / name) for device in ("cpu", word))
        assert one.keys() == other.keys() and all((one[key] == other[key]).all() for key in one)
    with pytest.raises(RunError, match="device"):
        trial(
            drawn / "test",
            tmp_path / "trial-cpu",
            {"two": f"{drawn / 'train'}:2"},
            TrialOptions(seeds=1, resamples=20, size=(64, 64), budget=TrainingBudget(iterations=2, device=word)),
        )
