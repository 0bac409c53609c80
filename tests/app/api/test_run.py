"""What can be done with a fit from Python, and with one of objects that its folder cannot give back."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import probscene as ps


def files_of(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_sampling_is_the_same_for_the_same_seed(python_run):
    """From the first call on, in which the guide is read."""
    run = ps.Run.open(python_run.path)
    first, again, other = run.sample(70, seed=4), run.sample(70, seed=4), run.sample(70, seed=5)
    assert torch.equal(first.derivation.rules, again.derivation.rules)
    assert first.derivation.rules.tolist() != other.derivation.rules.tolist()
    assert all(torch.equal(first.parameters[name], again.parameters[name]) for name in first.parameters)
    before = torch.get_rng_state()
    run.sample(3)
    assert torch.equal(torch.get_rng_state(), before)


def test_what_it_renders_is_what_it_samples(python_run):
    batch, scenes = python_run.render(5, seed=2), python_run.sample(5, seed=2)
    assert batch.image.shape == (5, 3, 64, 64) and batch.image.dtype == torch.uint8
    assert torch.equal(batch.kind, scenes.derivation.kind)
    assert torch.equal(ps.render(python_run.model, scenes).image, batch.image)
    prior = ps.sample(python_run.model, python_run.model.prior, 4)
    assert ps.render(python_run.model, prior).image.shape == (4, 3, 64, 64)


def test_generating_writes_the_bytes_of_the_command(python_run, call, tmp_path):
    made = python_run.generate(70, tmp_path / "python", format=["coco", "yolo"], seed=3, progress=False)
    words = ["--num", 70, "--out", tmp_path / "command", "--format", "coco", "--format", "yolo", "--seed", 3]
    assert call("generate", python_run.path, *words).code == 0
    by_folder = ps.generate(python_run.path, 70, tmp_path / "folder", ["coco", "yolo"], seed=3, progress=False)
    assert made.made == by_folder.made == 70 and made.path == tmp_path / "python"
    assert files_of(tmp_path / "python") == files_of(tmp_path / "command") == files_of(tmp_path / "folder")
    assert python_run.generate(70, tmp_path / "python", format="coco,yolo", seed=3, progress=False).made == 0


def test_it_is_evaluated_with_its_target_and_with_another(python_run, target):
    own = python_run.evaluate(num=200, progress=False)
    images = np.stack([np.asarray(Image.open(file)) for file in sorted(target.images.glob("*.png"))])
    other = ps.evaluate(python_run, images, num=200, progress=False)
    labelled = python_run.evaluate(labels=target.labels, num=200, progress=False)
    assert own.record()["sources"] == other.record()["sources"]
    assert "truth" in labelled.sources


def test_it_is_reported_and_compared(python_run, tmp_path, target):
    page = python_run.report(tmp_path / "page.html", num=100, scenes=0, progress=False)
    assert page == tmp_path / "page.html" and "<html" in page.read_text(encoding="utf-8")
    second = python_run.save(tmp_path / "second")
    found = ps.compare([python_run.path, str(second.path)], out=tmp_path / "both.png", num=100, progress=False)
    assert list(found.runs) == ["run", "second"] and (tmp_path / "both.png").is_file()
    assert ps.compare([python_run, second], num=100, progress=False).record() == found.record()
    with pytest.raises(ps.RunError, match="different names.*save the run under another name"):
        ps.compare([python_run, python_run], num=100, progress=False)


def test_it_is_saved_where_nothing_is_yet(python_run, tmp_path):
    saved = python_run.save(tmp_path / "runs" / "one")
    assert files_of(saved.path) == files_of(python_run.path)
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["one"]
    (tmp_path / "empty").mkdir()
    assert files_of(python_run.save(str(tmp_path / "empty")).path) == files_of(python_run.path)
    for taken in (saved.path, tmp_path):
        with pytest.raises(ps.RunError, match="expected a new"):
            python_run.save(taken)
    (tmp_path / "file").write_text("")
    with pytest.raises(ps.DataError, match="expected a folder"):
        python_run.save(tmp_path / "file" / "run")


def test_scenes_are_a_positive_number(python_run):
    for wrong in (lambda: python_run.sample(0), lambda: python_run.render(-1), lambda: python_run.sample(2, seed=-1)):
        with pytest.raises(ps.ProbsceneError, match="^expected a "):
            wrong()


class Grey:
    names = ("grey", "spread")

    def embed(self, images):
        pixels = images.float().flatten(1) / 16
        return torch.stack([pixels.mean(1), pixels.std(1)], 1)


class Flat(ps.Guide):
    def __init__(self, grammar, max_steps):
        super().__init__(grammar, max_steps)
        self.table = torch.nn.Parameter(torch.zeros(len(grammar.rules)))

    def step(self, memory, frontier, previous_rule):
        return self.table.expand(len(previous_rule), -1), memory


def away(generated, real):
    return torch.cdist(generated, real).mean(1)


@pytest.fixture(scope="module")
def of_objects(quick, discs, target, tmp_path_factory):
    """A run of which the folder can give back nothing, and what it was begun with."""
    model = replace(ps.load_model(discs.file), name="my discs")
    images = np.stack([np.asarray(Image.open(file)) for file in sorted(target.images.glob("*.png"))])
    parts = {"features": Grey(), "divergence": away, "guide": Flat}
    run = quick(model, images, out=tmp_path_factory.mktemp("objects") / "run", **parts)
    return run, {"model": model, **parts}, images


def test_objects_are_asked_for_again(of_objects, tmp_path):
    run, objects, images = of_objects
    everything = r"Run\.open\('.*', model=\.\.\., features=\.\.\., divergence=\.\.\., guide=\.\.\.\)"
    with pytest.raises(ps.RunError, match=rf"model \(my discs\), features \(Grey\).*{everything}"):
        ps.Run.open(run.path)
    with pytest.raises(ps.RunError, match=r"guide=\.\.\."):
        ps.Run.open(run.path, model=objects["model"])
    few = ps.Run.open(run.path, model=objects["model"], guide=Flat)  # enough for scenes
    assert torch.equal(few.sample(5).derivation.rules, run.sample(5).derivation.rules)
    with pytest.raises(ps.RunError, match=r"features=\.\.\., divergence=\.\.\.\)"):
        few.evaluate(images, num=50, progress=False)
    whole = ps.Run.open(run.path, **objects)
    whole.generate(3, tmp_path / "dataset", progress=False)
    assert (
        whole.evaluate(images, num=50, progress=False).record() == run.evaluate(images, num=50, progress=False).record()
    )
    with pytest.raises(ps.RunError, match="expected the images .* in memory"):
        whole.evaluate(num=50, progress=False)
    assert whole.report(tmp_path / "page.html", num=50, scenes=0, progress=False).is_file()
    saved = whole.save(tmp_path / "saved")
    assert torch.equal(saved.sample(5).derivation.rules, run.sample(5).derivation.rules)


@pytest.mark.parametrize("command", ["generate", "evaluate", "report", "resume"])
def test_the_command_line_says_in_one_line_what_a_folder_lacks(of_objects, call, target, tmp_path, command):
    run, _, _ = of_objects
    shutil.copytree(run.path, tmp_path / "run")
    words = {
        "generate": ["generate", tmp_path / "run", "--num", 3, "--out", tmp_path / "dataset"],
        "evaluate": ["evaluate", tmp_path / "run", "--target", target.images],
        "report": ["report", tmp_path / "run"],
        "resume": ["fit", "--out", tmp_path / "run", "--resume"],
    }[command]
    if command == "resume":
        (tmp_path / "run" / "guide.safetensors").unlink()
    done = call(*words)
    lines = done.err.strip().splitlines()
    assert done.code == 2 and "Run.open(" in lines[-1] and "Traceback" not in done.err
    assert sum(line.startswith("probscene: ") for line in lines) == 1


def test_a_run_of_objects_is_generated_in_one_process(of_objects, tmp_path):
    run, objects, _ = of_objects
    with pytest.raises(ps.ProbsceneError, match="one worker .*model, features, divergence, guide.* got 2"):
        run.generate(3, tmp_path / "dataset", workers=2, progress=False)
    with pytest.raises(ps.ProbsceneError, match="one worker"):
        ps.generate(objects["model"], 3, tmp_path / "dataset", workers=2, progress=False)
    assert not (tmp_path / "dataset").exists()
