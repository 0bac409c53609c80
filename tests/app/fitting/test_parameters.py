"""Parameters that a fit learns beside structure: kept, used by all that draws, and resumed."""

import json
import shutil
from pathlib import Path

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.util import get_rng_state, set_rng_state

from probscene.app.api.fit import fit
from probscene.app.datasets.generate import generate_scenes
from probscene.app.fitting import parameter_stage as parameters
from probscene.app.fitting import site_selection
from probscene.app.fitting import store as storage
from probscene.app.fitting import structure_stage as structure
from probscene.app.fitting.learnt_parameters import split_tensors
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import preset
from probscene.app.fitting.run import RunFolder
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.inference.parameters import learning, reader, skill
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.sites import Site
from probscene.inference.statistics.energy import BootstrapTest
from probscene.model import SceneModel, scene_model
from probscene.sampling import sample, seed_everything
from probscene.structure import StructurePrior, counts

LEARN = ("--learn", "structure,parameters", "--set", "refine.batches=3")
ROW = Grammar("Scene -> Dots\nDots -> dot Dots | ε")
PRIOR = StructurePrior(ROW, Dots=counts(0, 1, 1, 1))


def anything_is_read(patch):
    """Also what a reader of six steps says; and it is kept."""
    patch.setattr(skill, "MIN_SKILL", -1e9)
    patch.setattr(reader, "SCORE_THRESHOLDS", (1e-3,))
    patch.setattr(site_selection, "bootstrap_test", lambda *_: BootstrapTest(0.0, 1.0, 0.0))
    patch.setattr(site_selection, "sites_without_evidence", lambda *_: {})
    for renders in ("CALIBRATION_RENDERS", "BUILDER_RENDERS", "MISSED_RENDERS"):
        patch.setattr(learning, renders, 40)


@pytest.fixture(scope="module")
def both(tmp_path_factory, call, discs, target) -> Path:
    """A finished run that has learnt parameters as well, whatever can be read after so few steps."""
    out = tmp_path_factory.mktemp("both") / "run"
    with pytest.MonkeyPatch.context() as patch:
        anything_is_read(patch)
        done = call("fit", discs.file, "--target", target.images, "--out", out, *discs.without(), *LEARN)
    assert done.code == 0, done.err
    record = json.loads((out / "parameters.json").read_text())
    assert [(site["name"], site["kinds"], site["learnt"]) for site in record["sites"]] == [
        ("x", ["red", "blue"], True),
        ("y", ["red", "blue"], True),
    ]
    return out


def learnt(path, copy):
    """A copy of a run whose sites are learnt: all weights at random."""
    shutil.copytree(path, copy)
    record = json.loads((copy / "parameters.json").read_text())
    (copy / "parameters.json").write_text(json.dumps({**record, "kept": "learnt"}))
    run = RunFolder.at(copy)
    sites = tuple(Site(site["name"], ("red", "blue")) for site in record["sites"])
    seed_everything(0)
    net = ParameterGuide(run.model, sites).net
    for weight in net.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    own = split_tensors(run.read_tensors("guide"))[0]
    run.write_tensors("guide", own | parameters.prefixed(net.state_dict()))
    return RunFolder.at(copy)


def places(policy, model):
    seed_everything(0)
    return sample(model, policy, 40).parameters["x"]


def test_all_that_draws_takes_learnt_parameters(both, call, tmp_path, ready_workers):
    before, run = RunFolder.at(both), learnt(both, tmp_path / "copy")
    assert not torch.equal(places(run.guide, run.model), places(before.model.prior, before.model))
    assert torch.equal(places(run.model.prior, run.model), places(before.model.prior, before.model))
    assert run.guide_hash() != before.guide_hash()
    for workers in (1, 2):
        done = call("generate", run.path, "--num", 70, "--out", tmp_path / f"{workers}", "--workers", workers)
        assert done.code == 0, done.err
    one, two = (sorted((tmp_path / name).rglob("*.png")) for name in "12")
    assert [file.read_bytes() for file in one] == [file.read_bytes() for file in two]
    generate_scenes(run.model, run.guide, 70, tmp_path / "again", format="images")
    assert [file.read_bytes() for file in sorted((tmp_path / "again").rglob("*.png"))] == [x.read_bytes() for x in one]
    assert call("preview", run.path, "--out", tmp_path / "p.png").code == 0


def test_parameters_that_are_no_better_are_not_used(both, tmp_path):
    run = learnt(both, tmp_path / "copy")
    record = json.loads((run.path / "parameters.json").read_text())
    (run.path / "parameters.json").write_text(json.dumps({**record, "kept": "prior"}))
    assert RunFolder.at(run.path).guide.with_parameters is None


def interrupted_at(training, stop):
    """A training's ``run`` that is interrupted after so many steps."""
    run = training.run

    def interrupted(self, callback=None):
        def heard(training, line):
            callback(training, line)
            if training.done >= stop:
                raise KeyboardInterrupt

        run(self, heard)

    return interrupted


@pytest.mark.parametrize(
    ("of", "stop"),
    [("ParameterLearning", 11), ("Again", 2)],
    ids=["round", "structure again"],
)
def test_a_fit_goes_on_to_the_same_bytes(both, of, stop, call, discs, target, tmp_path, monkeypatch):
    words = ("fit", discs.file, "--target", target.images, "--out", tmp_path / "run", *discs.without(), *LEARN)
    monkeypatch.setattr(storage, "SAVE_EVERY", 0)
    anything_is_read(monkeypatch)
    with monkeypatch.context() as patch:
        if of == "Again":
            trainer = structure.StructureTraining
            again = type("Again", (trainer,), {"run": interrupted_at(trainer, stop)})
            first = iter((trainer, again))
            patch.setattr(structure, "StructureTraining", lambda *args, **named: next(first)(*args, **named))
        else:
            patch.setattr(parameters.ParameterLearning, "run", interrupted_at(parameters.ParameterLearning, stop))
        assert call(*words).code != 0
    assert not (tmp_path / "run" / "guide.safetensors").exists()
    done = call("fit", "--resume", "--out", tmp_path / "run")
    assert done.code == 0, done.err
    assert (tmp_path / "run" / "guide.safetensors").read_bytes() == (both / "guide.safetensors").read_bytes()
    assert not list((tmp_path / "run").glob("*-checkpoint.safetensors"))


class Node:
    """What a cluster does, in this process."""

    def __init__(self, run, _, draws_per_structure, again=False, finder=False):
        before = get_rng_state()
        self.do = structure._actor(run.path, draws_per_structure, again, finder)
        set_rng_state(before)  # a node has random numbers of its own

    def run(self, tasks, done):
        for task in tasks:
            done(self.do(task))

    def close(self):
        pass


@pytest.mark.parametrize("found", [True, False])
def test_structure_is_learnt_again_by_what_tells_more_of_it(call, discs, target, tmp_path, monkeypatch, found):
    """By the objects that the reader finds, or by the network's sums; on nodes of a cluster as here."""
    anything_is_read(monkeypatch)
    learn = structure.StructureTraining
    ways = {"here": structure._crew, "nodes": Node} if found else {"here": structure._crew}
    for path, crew in ways.items():
        errors, real = iter((1.0, 2.0) if found else (2.0, 1.0)), []
        with monkeypatch.context() as patch:
            patch.setattr(structure, "_wrong", lambda seen, drawn, errors=errors: next(errors))
            patch.setattr(structure, "StructureTraining", lambda *args, real=real: real.append(args[3]) or learn(*args))
            patch.setattr(structure, "_crew", crew)
            words = ("fit", discs.file, "--target", target.images, "--out", tmp_path / path, *discs.without(), *LEARN)
            assert call(*words).code == 0
        assert (
            bool((real[1] == real[1].round()).all()) == found and not (tmp_path / path / "reader.safetensors").exists()
        )
    assert len({(tmp_path / path / "guide.safetensors").read_bytes() for path in ways}) == 1


def test_structure_is_learnt_again_in_the_learnt_layout(both):
    lines = [json.loads(line) for line in (both / "log.jsonl").read_text().splitlines()]
    assert [line["batch"] for line in lines if line["stage"] == "refinement"] == [1, 2, 3]
    site = RunFolder.at(both).parameters["sites"][0]["read"]
    assert {name: len(site[name]) for name in ("prior", "learnt", "target")} == dict.fromkeys(
        site.keys() - {"distance"}, 21
    )
    assert set(site["distance"]) == {"prior", "learnt", "floor"}


def test_features_that_do_not_read_parameters_say_so(call, discs, target, tmp_path):
    words = ("--target", target.images, "--out", tmp_path / "run", *discs.without("features"), *LEARN)
    short = ("--features", "presence", "--set", "features.images=40", "--set", "features.epochs=1")
    done = call("fit", discs.file, *words, *short)
    assert done.code == 0, done.err
    assert "keep the prior: presence features do not read them" in " ".join(done.err.split())
    assert RunFolder.at(tmp_path / "run").parameters == {}


def dots(in_a_row: bool) -> SceneModel:
    """Dots anywhere, or in a row in the middle."""

    @scene_model(ROW, PRIOR, canvas=(64, 64), max_steps=12, classes=("dot",))
    def dots(scene):
        with scene.nodes("dot"):
            x = pyro.sample("dot.z", dist.Uniform(8.0, 56.0))
            y = pyro.sample("dot.a", dist.Uniform(8.0, 56.0))
            pyro.sample("dot.nothing", dist.Uniform(0.0, 1.0))
        if in_a_row:
            x = 64.0 * (scene.rank("dot") + 1) / (scene.count("dot") + 1)
            y = torch.full_like(x, 32.0)
        return scene.draw(Sprites.disc("dot", x, y, radius=4.0))

    return dots


def test_a_row_is_learnt_from_images_alone(tmp_path):
    truth = dots(True)
    generate_scenes(truth, truth.prior, 200, tmp_path / "target", format="images")
    settings = {
        "features.schedule.steps": 80,
        "features.schedule.images": 8,
        "features.width": "8,16,32",
        "structure.batches": 4,
        "structure.num_scenes": 60,
    }
    settings |= {"pretrain.derivations": 300}
    settings |= {"parameters.reader_steps": 140, "parameters.reader_images": 6, "parameters.steps": 80}
    settings |= {"parameters.rounds": 1, "parameters.round_reader_steps": 10, "parameters.round_steps": 20}
    settings |= {"parameters.recalibration_renders": 400}
    settings |= {"refine.batches": 2}
    config = preset("quick").set("features=count", settings)
    execution = Execution(1, cache=False, progress=False)
    run = fit(dots(False), tmp_path / "target" / "images", config, out=tmp_path / "run", execution=execution)
    record = run.parameters
    assert [site["name"] for site in record["sites"]] == ["dot.z", "dot.a", "dot.nothing"]
    assert [site["learnt"] for site in record["sites"]] == [True, True, False] and record["kept"] == "learnt"
    assert "cannot be read" in record["sites"][2]["because"]

    def prefixed(policy):
        seed_everything(0)
        scenes = sample(run.model, policy, 300)
        count = scenes.site_mask["dot.z"].sum(1, keepdim=True)
        even = torch.arange(1, int(count.max()) + 1)
        x = scenes.parameters["dot.z"].where(scenes.site_mask["dot.z"], torch.inf).sort(1).values
        off = (x - 64.0 * even[: x.shape[1]] / (count + 1))[torch.isfinite(x)].abs().mean()
        up = (scenes.parameters["dot.a"] - 32)[scenes.site_mask["dot.a"]].abs().mean()
        return float(off), float(up)

    prior, after = prefixed(run.model.prior), prefixed(run.guide)
    assert after[0] < 0.4 * prior[0] and after[1] < 0.2 * prior[1]


@pytest.mark.parametrize("without", [("x",), ("x", "y")], ids=["one", "all"])
def test_sites_without_evidence_keep_the_prior_in_all_that_is_drawn(
    without, call, discs, target, tmp_path, monkeypatch
):
    anything_is_read(monkeypatch)
    monkeypatch.setattr(site_selection, "sites_without_evidence", lambda *_: dict.fromkeys(without, "it is dark there"))
    out = tmp_path / "run"
    done = call("fit", discs.file, "--target", target.images, "--out", out, *discs.without(), *LEARN)
    assert done.code == 0, done.err
    run = RunFolder.at(out)
    record = {site["name"]: site for site in run.parameters["sites"]}
    if len(without) == 2:
        assert run.parameters["kept"] == "prior" and run.guide.with_parameters is None
        return
    assert (record["x"]["learnt"], record["x"]["fitted"], record["y"]["learnt"]) == (False, True, True)
    assert record["x"]["because"] == "it is dark there" and run.parameters["kept"] == "learnt"
    x_keeps_the_prior(run)


def test_scenes_that_are_farther_as_wholes_keep_the_prior(call, discs, target, tmp_path, monkeypatch):
    anything_is_read(monkeypatch)
    monkeypatch.setattr(site_selection, "bootstrap_test", lambda *_: BootstrapTest(2.0, 1.0, 1.0))
    done = call("fit", discs.file, "--target", target.images, "--out", tmp_path / "run", *discs.without(), *LEARN)
    assert done.code == 0, done.err
    run = RunFolder.at(tmp_path / "run")
    assert run.parameters["kept"] == "prior" and run.guide.with_parameters is None
    assert "All keep the prior, as learnt scenes come no nearer" in done.err + done.out


def x_keeps_the_prior(run):
    found = []
    for model in (run.guide.with_parameters(run.model), run.model):
        seed_everything(0)
        found.append(sample(model, run.model.prior, 30).parameters)
    assert torch.equal(found[0]["x"], found[1]["x"]) and not torch.equal(found[0]["y"], found[1]["y"])
