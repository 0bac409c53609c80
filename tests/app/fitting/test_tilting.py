"""``fit --parameters tilting``: kept, used by all that draws, and resumed; for photographs it is the way."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from probscene.app.detectors import source_comparison
from probscene.app.detectors.source_comparison import SourceComparison, compare_and_keep
from probscene.app.fitting import parameter_stage, site_selection
from probscene.app.fitting import store as storage
from probscene.app.fitting.image_level import labelled_objects
from probscene.app.fitting.presets import preset
from probscene.app.fitting.rendered_features import RenderedFeatures
from probscene.app.fitting.run import RunFolder
from probscene.app.labels.partial_labels import PartialLabels
from probscene.app.loading import load_model
from probscene.app.progress import silent
from probscene.dataset import ImageFolder
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.tilting import learning
from probscene.inference.parameters.tilting.objects import objects_of
from probscene.inference.statistics.energy import BootstrapTest
from probscene.sampling import sample, seed_everything

SCHEDULE = {"rounds": 3, "first": 50, "scenes": 20, "steps": 4, "images": 20}
SETTINGS = [word for key, value in SCHEDULE.items() for word in ("--set", f"parameters.{key}={value}")]
LEARN = ("--learn", "structure,parameters", "--parameters", "tilting", "--set", "refine.batches=2", *SETTINGS)


@pytest.fixture(scope="module")
def lit(tmp_path_factory, discs) -> Path:
    """The model's file with a light of the whole scene."""
    text = discs.file.read_text().replace("import pyro\n", "import pyro\nimport torch\n", 1)
    place = '            y = pyro.sample("y", dist.Uniform(8.0, 56.0))\n'
    text = text.replace(place, place + '        light = pyro.sample("light", dist.Uniform(0.2, 1.0))\n')
    for tint in ("(1.0, 0.2, 0.2)", "(0.2, 0.2, 1.0)"):
        text = text.replace(f"tint={tint}", f"tint=light[..., None] * torch.tensor({tint})")
    assert text.count("light") == 4
    file = tmp_path_factory.mktemp("lit") / "lit.py"
    file.write_text(text)
    return file


def it_is_kept(patch):
    patch.setattr(site_selection, "bootstrap_test", lambda *_, **__: BootstrapTest(0.0, 1.0, 0.0))
    patch.setattr(learning, "FALSE_DISCOVERY_RATE", 1.1)  # of so few scenes, whatever they say


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, call, lit, discs, target) -> Path:
    """A finished run."""
    out = tmp_path_factory.mktemp("tilting") / "run"
    with pytest.MonkeyPatch.context() as patch:
        it_is_kept(patch)
        done = call("fit", lit, "--target", target.images, "--out", out, *discs.without("parameters"), *LEARN)
    assert done.code == 0, done.err
    assert "Learnt sites: light. Sites that keep the prior: x, y." in " ".join(done.err.split())
    return out


def test_a_run_keeps_what_it_has_learnt(fitted):
    run = RunFolder.at(fitted)
    assert run.config.parameter_method == run.parameters["method"] == "tilting"
    assert [(site["name"], site["learnt"], site["because"]) for site in run.parameters["sites"]] == [
        ("x", False, "it is of single objects, and no box of one is known"),
        ("y", False, "it is of single objects, and no box of one is known"),
        ("light", True, ""),
    ]
    assert run.parameters["kept"] == "learnt" and isinstance(run.guide.with_parameters.__self__, ParameterGuide)
    assert run.config.parameters.rounds == 3
    log = [json.loads(line) for line in (fitted / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in log if line["stage"] == "parameters"] == [1, 2, 3]


def test_all_that_draws_takes_them(fitted, call, tmp_path):
    run = RunFolder.at(fitted)
    guide = run.guide
    seed_everything(0)
    moved = sample(run.model, guide, 40).parameters
    guide.with_parameters = None
    seed_everything(0)
    still = sample(run.model, guide, 40).parameters
    assert torch.equal(moved["x"], still["x"]) and not torch.equal(moved["light"], still["light"])
    assert call("preview", fitted, "--out", tmp_path / "p.png").code == 0
    assert call("report", fitted).code == 0


def test_structure_and_parameters_can_be_drawn_each_for_itself(fitted):
    run = RunFolder.at(fitted)
    assert run.generated_sources() == ("prior", "structure", "parameters", "learnt")
    drawn = {}
    for source in run.generated_sources():
        seed_everything(0)
        drawn[source] = sample(run.model, run.policy(source), 40)
    light = {source: scenes.parameters["light"] for source, scenes in drawn.items()}
    rules = {source: scenes.derivation.rules for source, scenes in drawn.items()}
    assert torch.equal(rules["prior"], rules["parameters"]) and not torch.equal(light["prior"], light["parameters"])
    assert torch.equal(rules["structure"], rules["learnt"]) and not torch.equal(light["structure"], light["learnt"])


@pytest.mark.parametrize("better", ["learnt", "structure", "prior"])
def test_parameters_are_given_back_where_detectors_are_better_without(fitted, tmp_path, monkeypatch, better):
    run = RunFolder.at(shutil.copytree(fitted, tmp_path / "run"))
    agreement = {"learnt": [0.5], "prior": [0.4]} | ({} if better == "learnt" else {"structure": [0.6], better: [0.7]})
    found = SourceComparison(max(agreement, key=agreement.get), agreement, ("red",), 9)
    monkeypatch.setattr(source_comparison, "compare_sources", lambda *_: found)
    before, told = run.guide_hash(), []
    kept = compare_and_keep(run, None, silent, told.append)
    again = RunFolder.at(run.path)
    assert again.sources == kept.record() and kept.source == {"structure": "learnt"}.get(better, better)
    for each in (run, again):
        assert (each.guide.with_parameters is not None) is (better == "learnt")
    assert (run.guide_hash() == before) is (better == "learnt")
    because = "detectors count better when they are trained on scenes with the prior's"
    assert (again.parameters["sites"][2]["because"] == because) is (better != "learnt")
    assert len(told) == (1 if better == "learnt" else 2)


def test_a_fit_goes_on_to_the_same_bytes(fitted, call, lit, discs, target, tmp_path, monkeypatch):
    it_is_kept(monkeypatch)
    monkeypatch.setattr(storage, "SAVE_EVERY", 0)
    run, out = learning.TiltingLearning.run, tmp_path / "run"

    def interrupted(self, callback=None):
        def heard(training, line):
            callback(training, line)
            if training.done == 2:
                raise KeyboardInterrupt

        run(self, heard)

    with monkeypatch.context() as patch:
        patch.setattr(learning.TiltingLearning, "run", interrupted)
        words = ("--target", target.images, "--out", out, *discs.without("parameters"), *LEARN)
        assert call("fit", lit, *words).code != 0
    assert (out / "parameters-checkpoint.safetensors").exists()
    done = call("fit", "--resume", "--out", out)
    assert done.code == 0, done.err
    for name in ("guide.safetensors", "parameters.json"):
        assert (out / name).read_bytes() == (fitted / name).read_bytes()


def test_where_images_say_nothing_the_prior_is_kept(call, lit, discs, target, tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "FALSE_DISCOVERY_RATE", 0.0)
    out = tmp_path / "run"
    done = call("fit", lit, "--target", target.images, "--out", out, *discs.without("parameters"), *LEARN)
    assert done.code == 0, done.err
    said = " ".join(done.err.split())
    assert "No site can be moved, so position and appearance keep the prior." in said
    run = RunFolder.at(out)
    assert run.parameters["kept"] == "prior" and run.guide.with_parameters is None
    assert run.parameters["sites"][2]["because"] == "the similarity of images does not depend on it"


@pytest.fixture(scope="module")
def to_the_right(lit):
    """Labelled objects of the model, which stand in the right half of their images."""
    model = load_model(str(lit))
    seed_everything(7)
    drawn = RenderedFeatures(model, 1).draw(60)
    right = drawn.centre[..., 0] > 34
    return objects_of(drawn._replace(label=drawn.label.where(right, -1)))


def test_labelled_objects_move_sites_of_objects(to_the_right, call, lit, discs, target, tmp_path, monkeypatch):
    it_is_kept(monkeypatch)
    monkeypatch.setattr(parameter_stage, "labelled_objects", lambda *_: to_the_right)
    out = tmp_path / "run"
    settings = ("--set", "parameters.first=200", "--set", "parameters.scenes=100", "--set", "parameters.steps=40")
    words = (*discs.without("parameters"), *LEARN, *settings, "--set", "parameters.rate=0.02")
    done = call("fit", lit, "--target", target.images, "--out", out, *words)
    assert done.code == 0, done.err
    run = RunFolder.at(out)
    sites = {site["name"]: site for site in run.parameters["sites"]}
    assert sites["x"]["learnt"] and not sites["y"]["learnt"]
    assert sites["y"]["because"] == "labelled objects do not depend on it"
    seed_everything(0)
    scenes = sample(run.model, run.guide, 200)
    assert 36 < float(scenes.parameters["x"][scenes.site_mask["x"]].mean())  # 32 in the prior, 45 in the labels


def test_what_takes_objects_away_from_the_labelled_ones_is_discarded(
    to_the_right, call, lit, discs, target, tmp_path, monkeypatch
):
    it_is_kept(monkeypatch)
    monkeypatch.setattr(parameter_stage, "labelled_objects", lambda *_: to_the_right)
    monkeypatch.setattr(site_selection, "objects_farther", lambda *_: True)
    out = tmp_path / "run"
    done = call("fit", lit, "--target", target.images, "--out", out, *discs.without("parameters"), *LEARN)
    assert done.code == 0, done.err
    light = RunFolder.at(out).parameters["sites"][2]
    assert light["fitted"] and not light["learnt"]
    assert light["because"] == "objects get farther from the labelled ones by it"


def test_objects_are_farther_where_their_light_is_other_and_not_where_it_is_the_same(lit):
    render, parts = RenderedFeatures(load_model(str(lit)), 1), []
    for seed, share in ((0, 1.0), (1, 0.4), (2, 1.0)):
        seed_everything(seed)
        drawn = render.draw(60)
        parts.append(drawn._replace(image=(share * drawn.image).byte()))
    same, dark, other = parts
    real = objects_of(same)
    assert site_selection.objects_farther({"learnt": [dark], "prior": [other]}, real)
    assert not site_selection.objects_farther({"learnt": [other], "prior": [dark]}, real)


def test_labelled_objects_are_those_of_the_boxes(lit, target):
    """Measured in the target's images, as the model's classes."""
    run = SimpleNamespace(model=load_model(str(lit)))
    images = ImageFolder(target.images, (64, 64), 3)
    boxes = (torch.tensor([[0, 4.0, 6.0, 20.0, 18.0]]), torch.zeros(0, 5), torch.tensor([[0, 30.0, 31.0, 40.0, 50.0]]))
    labels = PartialLabels(torch.tensor([1, 4, 7]), torch.zeros(3, 1), ("blue",), boxes, ())
    found = labelled_objects(run, labels.as_boxes, images)
    assert found.image.tolist() == [0, 2] and found.label.tolist() == [1, 1] and found.images == 3
    assert found.seen[0, :2] == pytest.approx(np.log([16, 12])) and found.seen[1, :2] == pytest.approx(np.log([10, 19]))
    inside = images.load(7)[:, 31:50, 30:40].double().mean((1, 2)) / 255
    assert found.seen[1, 4:7] == pytest.approx(inside.numpy())
    assert labels._replace(boxes=None).as_boxes is None
    assert labelled_objects(run, None, images) is None


def test_it_is_the_way_for_photographs():
    street = preset("street").with_features("count=efficientnet")
    assert street.parameter_method == "tilting"
    assert preset("street").with_features("count").parameter_method == "likelihood"
