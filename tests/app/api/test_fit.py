"""``ps.fit``: where images come from makes no difference, nothing is done twice, and nothing is left behind."""

import gc
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

import probscene as ps
from probscene.app.api.calls import display
from probscene.app.targets import open_images
from probscene.inference.features import pretrained

FILES = ("features.safetensors", "guide.safetensors", "log.jsonl")


def learnt(run):
    """The bytes of what a run has learnt."""
    found = {name: (run.path / name).read_bytes() for name in FILES}
    return found | {"real": load_file(run.path / "real.safetensors")["features"].numpy().tobytes()}


class Pictures(torch.utils.data.Dataset):
    """A torch dataset of an image and a label."""

    def __init__(self, images, change):
        self.images, self.change = images, change

    def __len__(self):
        return len(self.images)

    def __getitem__(self, i):
        return self.change(self.images[i]), i


def planar(image):
    """``(C, H, W)``, as torchvision has it."""
    return torch.tensor(image).permute(2, 0, 1) if image.ndim == 3 else torch.tensor(image)[None]


def sources(files):
    """The same images from everywhere that is not their folder."""
    images = np.stack([np.asarray(Image.open(file)) for file in files])
    return {
        "list": list(files),
        "words": [str(file) for file in files],
        "array": images,
        "tensor": torch.stack([planar(image) for image in images]),
        "dataset of bytes": Pictures(images, planar),
        "dataset of floats": Pictures(images, lambda image: planar(image).float() / 255),
        "dataset of Pillow's": Pictures(images, Image.fromarray),
        "list of arrays": list(images),
    }


@pytest.mark.parametrize("channels", [3, 1])
def test_the_same_images_from_everywhere_are_read_as_the_same(discs, tmp_path, channels):
    model = replace(ps.load_model(discs.file), channels=channels)
    ps.generate(model, 8, tmp_path, format="images", progress=False)
    files = sorted((tmp_path / "images").glob("*.png"))
    images = sources(files)
    if channels == 1:
        assert images["array"].shape == (8, 64, 64)
        images["one channel"] = images["array"][..., None]
    with display(False) as show:
        folder, *others = (open_images(each, model, False, show) for each in (tmp_path / "images", *images.values()))
    for name, other in zip(images, others, strict=True):
        assert len(other) == len(folder) == 8, name
        assert all(torch.equal(other.load(i, v), folder.load(i, v)) for i in range(8) for v in (0, 1)), name


@pytest.mark.parametrize("source", ["list", "array"])
def test_they_give_the_same_fit(quick, discs, target, python_run, source):
    images = sources(sorted(target.images.glob("*.png")))[source]
    assert learnt(quick(discs.file, images)) == learnt(python_run)


def test_so_they_do_in_grey(quick, discs, tmp_path):
    model = replace(ps.load_model(discs.file), channels=1)
    ps.generate(model, 40, tmp_path, format="images", progress=False)
    images = sources(sorted((tmp_path / "images").glob("*.png")))["array"]
    assert learnt(quick(model, images)) == learnt(quick(model, tmp_path / "images"))


def test_the_command_line_does_the_same(python_run, fitted):
    assert all((python_run.path / name).read_bytes() == (fitted / name).read_bytes() for name in FILES)
    mine, its = (json.loads((path / "run.json").read_text()) for path in (python_run.path, fitted))
    assert mine == its


def test_a_temporary_run_goes_with_its_object(quick, discs, target, tmp_path):
    run = quick(discs.file, target.images)
    folder = run.path
    kept = run.save(tmp_path / "kept")
    scenes = run.sample(3)
    assert folder.is_dir() and kept.path == tmp_path / "kept"
    del run
    gc.collect()
    assert not folder.parent.exists()
    assert torch.equal(kept.sample(3).derivation.rules, scenes.derivation.rules)


def test_a_temporary_run_that_fails_leaves_nothing(quick, discs, target, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def broken(generated, real):
        return torch.full((len(generated),), torch.nan)

    with pytest.raises(ps.ProbsceneError, match="finite values of broken"):
        quick(discs.file, target.images, divergence=broken)
    assert not list(tmp_path.iterdir())


def counting(text, tally):
    """A file that notes each time it is executed."""
    return f"with open({str(tally)!r}, 'a') as _file:\n    _file.write('x')\n{text}"


def test_files_are_executed_once_a_fit(quick, call, discs, target, tmp_path):
    model, parts, tally = tmp_path / "model.py", tmp_path / "parts.py", tmp_path / "tally"
    model.write_text(counting(discs.file.read_text(), tally))
    quick(model, target.images)
    assert tally.read_text() == "x"
    tally.unlink()
    assert call("fit", model, "--target", target.images, "--out", tmp_path / "run", *discs.settings).code == 0
    assert tally.read_text() == "x"
    parts.write_text(counting(PARTS, tally))
    tally.unlink()
    words = {key: f"{parts}:{name}" for key, name in (("features", "Grey"), ("divergence", "away"), ("guide", "Table"))}
    quick(discs.file, target.images, **words)
    assert tally.read_text() == "x"


PARTS = """
import torch
import probscene as ps

class Grey:
    names = ("grey",)

    def embed(self, images):
        return images.float().mean((1, 2, 3)).unsqueeze(1)

def away(generated, real):
    return torch.cdist(generated, real).mean(1)

class Table(ps.Guide):
    def __init__(self, grammar, max_steps):
        super().__init__(grammar, max_steps)
        self.table = torch.nn.Parameter(torch.zeros(len(grammar.rules)))

    def step(self, memory, frontier, previous_rule):
        return self.table.expand(len(previous_rule), -1), memory
"""


class Means(torch.nn.Module):
    names = ("red", "green", "blue", "white", "sharp")

    def embed(self, images):
        x = images.expand(-1, 3, -1, -1).float()
        more = torch.stack([x.amin(1).mean((1, 2)), x.std((1, 2, 3))], 1)
        return torch.cat([x.mean((2, 3)), more], 1)


def test_a_pretrained_network_is_built_once_a_fit(quick, discs, target, monkeypatch):
    built = []
    monkeypatch.setattr(pretrained, "pretrained", lambda choice: built.append(choice) or Means())
    monkeypatch.setattr(pretrained, "weights_file", lambda choice: None)
    few = {key: value for key, value in discs.short.items() if not key.startswith(("features", "parameters"))}
    few |= {"features.pairs": 60, "features.directions": 2}
    run = quick(discs.file, target.images, features="efficientnet", settings=few)
    run.evaluate(num=50, progress=False)
    run.sample(2)
    assert built == ["efficientnet"]


def test_resuming_takes_what_the_run_was_begun_with(quick, discs, target, python_run, tmp_path):
    again = quick(discs.file, target.images, out=python_run.path, resume=True)
    assert learnt(again) == learnt(python_run)
    for other in ({"seed": 1}, {"preset": "street"}, {"guide": "pcfg"}, {"threads": 2}, {"skip_bad": True}):
        with pytest.raises(ps.RunError, match="that the run in .* was begun with"):
            quick(discs.file, target.images, out=python_run.path, resume=True, **other)
    with pytest.raises(ps.RunError, match="expected the target that the run"):
        quick(discs.file, np.zeros((40, 64, 64, 3), np.uint8), out=python_run.path, resume=True)
    with pytest.raises(ps.RunError, match="expected the model that the run"):
        quick("multi_mnist", target.images, out=python_run.path, resume=True)
    with pytest.raises(ps.RunError, match="expected a new folder"):
        quick(discs.file, target.images, out=python_run.path)


def test_resuming_where_no_run_is_begins_one(discs, tmp_path):
    with pytest.raises(ps.DataError, match="got an empty list of files"):  # not that the configuration is missing
        ps.fit(discs.file, [], out=tmp_path / "run", resume=True)


def test_resuming_names_the_setting_that_differs(quick, discs, target, python_run):
    out, begun = python_run.path, python_run.config
    again = quick(discs.file, target.images, preset=begun, settings=(), out=out, resume=True)
    assert learnt(again) == learnt(python_run)
    other = begun.set({"features.schedule.steps": begun.features.schedule.steps + 1})
    with pytest.raises(ps.RunError, match="expected the features.schedule.steps that the run"):
        quick(discs.file, target.images, preset=other, settings=(), out=out, resume=True)


def test_a_fit_of_objects_goes_on_with_them(quick, discs, target, tmp_path, monkeypatch):
    model, images = ps.load_model(discs.file), sources(sorted(target.images.glob("*.png")))["array"]
    whole = quick(model, images, features=Means())
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(
            "probscene.app.fitting.structure_stage.pretrain", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt)
        )
        with pytest.raises(KeyboardInterrupt):
            quick(model, images, features=Means(), out=out)
    assert not (out / "guide.safetensors").exists()
    assert learnt(quick(model, images, features=Means(), out=out, resume=True)) == learnt(whole)
