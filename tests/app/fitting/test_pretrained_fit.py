"""A fit by a pretrained network's features, through the command line."""

import json
import shutil

import pytest
import safetensors.torch
import torch
from torchvision.models import inception_v3

from probscene.app.evaluation import diagnose
from probscene.app.evaluation.explain import structure_remedy
from probscene.app.fitting.presets import QUICK, preset
from probscene.app.fitting.run import RunFolder
from probscene.app.fitting.scene_features import own_net
from probscene.dataset import ImageFolder
from probscene.errors import DataError, RunError
from probscene.inference.divergence import SELF_SHARE
from probscene.inference.features.base import embed_all
from probscene.inference.features.photographs import readability
from probscene.inference.features.photographs.net import PretrainedCountNet
from probscene.inference.statistics.verdict import Verdict

FEW = {"structure.batches": 2, "structure.num_scenes": 25, "pretrain.derivations": 50, "pretrain.epochs": 1}
WORDS = ["--preset", "quick", "--threads", "1", "--no-verdict"]
WORDS += [word for key, value in FEW.items() for word in ("--set", f"{key}={value}")]


@pytest.fixture(scope="module", autouse=True)
def _small_images_enter_the_heads():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PretrainedCountNet.__init__, "__defaults__", ((), 150, (128, 128)))
        yield


@pytest.fixture(scope="module")
def run(call, discs, target, tmp_path_factory):
    out = tmp_path_factory.mktemp("pretrained") / "run"
    words = ["fit", discs.file, "--target", target.images, "--out", out, *PROJECTED, *WORDS]
    done = call(*words)
    assert done.code == 0, done.err
    return RunFolder.at(out), words


def test_the_network_is_recorded_and_only_its_projection_kept(run, target):
    run, _ = run
    config = run.config
    assert config.features.network == "efficientnet" and config.divergence.marginal_variance is None
    net, images = own_net(run), ImageFolder(target.images, run.model.canvas, run.model.channels)
    assert (run.path / "features.safetensors").stat().st_size < 40_000
    seen = net.embed(torch.stack([images.load(i) for i in range(9)]))
    assert seen.shape == (9, len(net.names)) == (9, 3)
    assert torch.allclose(seen, run.read_tensors("real")["features"][:9], atol=1e-4)


def test_the_log_says_how_the_projection_came_out(run):
    first, *rest = map(json.loads, (run[0].path / "log.jsonl").read_text().splitlines())
    assert first["stage"] == "projection" and first["ratio"] == sorted(first["ratio"], reverse=True)
    assert first["self_share"] == pytest.approx(SELF_SHARE, rel=0.05) and first["ratio"][0] > 2
    assert [line["stage"] for line in rest] == ["structure"] * 2


def test_it_goes_on_to_the_same_result(run, call, tmp_path, discs, target):
    run, words = run
    again = tmp_path / "again"
    words = [again if word == run.path else word for word in words]
    assert call(*words).code == 0
    guide = (again / "guide.safetensors").read_bytes()
    assert guide == (run.path / "guide.safetensors").read_bytes()
    for name in ("guide", "real"):
        (again / f"{name}.safetensors").unlink()
    done = call("fit", "--out", again, "--resume", "--features", "count", *WORDS)
    assert done.code == 2 and "the features.kind" in done.err and "(ProjectedFeatures)" in done.err
    done = call("fit", "--out", again, "--resume", "--no-verdict")
    assert done.code == 0, done.err
    assert (again / "guide.safetensors").read_bytes() == guide


def test_a_finished_run_is_evaluated_and_reported(run, call, target, tmp_path):
    run, _ = run
    words = [
        "--target",
        target.images,
        "--labels",
        target.labels,
        "--num",
        200,
        "--scenes",
        40,
        "--json",
        tmp_path / "e.json",
    ]
    done = call("evaluate", run.path, *words)
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "e.json").read_text())
    structure = found["trust"]["parts"]["structure"]
    remedies = [structure_remedy(run, verdict) for verdict in Verdict]
    assert structure["remedy"] in remedies and not any("pretrained" in remedy for remedy in remedies)  # it has them
    assert "estimate" not in found["sources"] and "truth" in found["sources"]  # a direction is no count
    assert call("report", run.path, "--num", 200, "--scenes", 0, "--out", tmp_path / "r.html").code == 0


def test_further_views_of_the_target_are_learnt_from_and_not_judged(run, call, target, tmp_path):
    run, words = run
    again = tmp_path / "again"
    assert call(*[again if word == run.path else word for word in words], "--set", "num_crops=3").code == 0
    one, other = run.read_tensors("real"), RunFolder.at(again).read_tensors("real")
    assert torch.equal(one["features"], other["features"]) and other["views"].shape == (80, 3) and "views" not in one
    net, images = own_net(run), ImageFolder(target.images, run.model.canvas, run.model.channels)
    assert torch.allclose(embed_all(net, images.batches(64, 2)), other["views"][40:], atol=1e-4)
    guide = (again / "guide.safetensors").read_bytes()
    assert guide != (run.path / "guide.safetensors").read_bytes()
    (again / "guide.safetensors").unlink()
    done = call("fit", "--out", again, "--resume", "--no-verdict")  # with the features that are kept
    assert done.code == 0 and (again / "guide.safetensors").read_bytes() == guide
    done = call("evaluate", again, "--target", target.images, "--num", 50, "--scenes", 40)
    assert done.code == 0, done.err


@pytest.mark.parametrize(
    ("features", "part"),
    [("vgg", "presence, presence=counts, efficientnet, inception, inception=FILE"), ("inception=", "inception=FILE"),
     ("count=vgg", "count, count=efficientnet, presence"),
     ("inception=none.pth", "a file of weights"), ("resnet50=none.pth", "a file of weights"),
     ("efficientnet=x", "'efficientnet=x'")],
)  # fmt: skip
def test_another_network_is_refused_before_a_folder_is_made(features, part, call, discs, target, tmp_path):
    words = ["fit", discs.file, "--target", target.images, "--out", tmp_path / "run", "--features", features]
    done = call(*words, *WORDS)
    assert done.code == 2 and part in done.err and not (tmp_path / "run").exists()


def test_a_trained_network_keeps_the_presets_scenes():
    for name in ("quick", "paper"):
        assert preset(name).with_features("count").structure == preset(name).structure
    assert QUICK.with_features("presence").make_features().name == "presence"
    assert QUICK.with_features("efficientnet").structure.num_scenes < QUICK.structure.num_scenes


def test_weights_of_inception_are_those_that_the_run_was_begun_with(run, tmp_path):
    model, chosen = run[0].model, QUICK.with_features(f"inception={tmp_path / 'w.safetensors'}")
    for seed in (0, 1):
        torch.manual_seed(seed)
        weights = inception_v3(weights=None, aux_logits=False, init_weights=False).state_dict()
        safetensors.torch.save_file(weights, tmp_path / "w.safetensors")
        net = chosen.make_features().build(model)
        if seed == 0:
            assert net.embed(torch.zeros(2, 3, 64, 64, dtype=torch.uint8)).shape == (2, 8)
            state = net.state_dict()
            chosen.make_features().build(model).load_state_dict(state)
    with pytest.raises(RunError, match="put that file back"):
        net.load_state_dict(state)


PROJECTED = ["--features", "efficientnet", "--set", "features.pairs=40", "--set", "features.directions=3"]
ALONE = ["--learn", "structure", "--features", "count=efficientnet"]
COUNTING = [*ALONE, "--set", "features.pairs=60", "--set", "features.epochs=12"]


@pytest.fixture(scope="module")
def counting(call, discs, target, tmp_path_factory):
    out = tmp_path_factory.mktemp("counting") / "run"
    done = call("fit", discs.file, "--target", target.images, "--out", out, *WORDS, *COUNTING)
    assert done.code == 0, done.err
    return RunFolder.at(out), done.err


def test_counts_on_pretrained_maps_are_fitted_and_go_on_to_the_same_result(counting, call, target, tmp_path):
    run, said = counting
    assert "Image features" in said and "Readings" in said and "epochs" in said
    net, images = own_net(run), ImageFolder(target.images, run.model.canvas, run.model.channels)
    seen = net.embed_real(torch.stack([images.load(i) for i in range(9)]))
    assert net.names == run.model.classes
    assert torch.allclose(seen, run.read_tensors("real")["features"][:9], atol=1e-3)
    lines = [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]
    assert [line["stage"] for line in lines] == ["features"] * 13 + ["counts"] + ["structure"] * 2
    assert len(lines[13]["correlation"]) == len(run.model.classes)
    assert all(f"{name}: {found['because']}." in said for name, found in run.readings["classes"].items())
    guide = (run.path / "guide.safetensors").read_bytes()
    for name in ("guide", "real", "features"):
        (run.path / f"{name}.safetensors").unlink()
    assert call("fit", "--out", run.path, "--resume", "--no-verdict").code == 0
    assert (run.path / "guide.safetensors").read_bytes() == guide
    words = ["--target", target.images, "--num", 50, "--scenes", 40, "--json", tmp_path / "e.json"]
    done = call("evaluate", run.path, *words)
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "e.json").read_text())
    number = (run.read_tensors("real")["features"] * net.unit).round().sum(1)  # objects, whatever the features' unit is
    assert found["sources"]["estimate"]["mean_number"] == pytest.approx(number.mean().item(), abs=1e-6)
    assert found["readings"] == run.readings["classes"] and found["outcome"]["kept"] in ("learnt", "prior")
    assert "Read: " in done.out
    assert call("report", run.path, "--num", 50, "--scenes", 0, "--out", tmp_path / "r.html").code == 0


def test_a_verdict_compares_counts_to_half_an_object(counting, call, target, monkeypatch):
    """Renders are counted from their labels, in whole numbers, and photographs are not: 2.96 is 3."""
    seen = []

    def compared(generated, real, prior, *_, resolution, **__):
        seen.append((generated, prior, resolution))
        raise DataError("seen")

    monkeypatch.setattr(diagnose, "structure_verdict", compared)
    assert call("evaluate", counting[0].path, "--target", target.images, "--num", 50, "--scenes", 40).code == 0
    ((generated, prior, resolution),) = seen
    assert resolution == 0.5 and generated.max() > 1
    assert all(abs(counts - counts.round()).max() < 1e-4 for counts in (generated, prior))


def test_labels_choose_how_classes_are_read(counting, call, discs, target, tmp_path):
    few = tmp_path / "few.csv"
    few.write_text("".join(target.labels.read_text().splitlines(keepends=True)[:13]))
    words = ["fit", discs.file, "--target", target.images, "--out", tmp_path / "run", *WORDS, *COUNTING]
    done = call(*words, "--labels", few)
    assert done.code == 0, done.err
    found = RunFolder.at(tmp_path / "run").readings["classes"]
    assert all(each["error"] is not None and "12 labels" in each["because"] for each in found.values())


def test_a_target_in_which_nothing_can_be_read_gives_the_prior_back(call, discs, target, tmp_path, monkeypatch):
    """No heads are good enough; parameters are learnt as well."""
    monkeypatch.setattr(readability, "MIN_CORRELATION", 1.1)
    few = {"features.pairs": 12, "features.epochs": 1, "refine.batches": 2} | {
        f"parameters.{k}": 20 for k in ("first", "scenes")
    }
    chosen = [word for key, value in (few | {"parameters.rounds": 1}).items() for word in ("--set", f"{key}={value}")]
    words = [*WORDS, "--features", "count=efficientnet", *chosen]
    done = call("fit", discs.file, "--target", target.images, "--out", tmp_path / "run", *words)
    assert done.code == 0 and done.err.count("not readable") == 2 and "the prior is kept" in done.err, done.err
    run = RunFolder.at(tmp_path / "run")
    assert run.guide is run.model.prior and run.outcome["kept"] == "prior"
    assert set(run.unread) == set(run.model.classes)
    assert call("generate", run.path, "--num", 3, "--out", tmp_path / "d").code == 0
    done = call("evaluate", run.path, "--target", target.images, "--num", 50, "--scenes", 0)
    assert done.code == 0 and "The prior is kept" in done.out, done.err


def test_readings_are_of_the_runs_images(call, discs, target, tmp_path):
    images = tmp_path / "images"
    shutil.copytree(target.images, images)
    words = [*WORDS, *ALONE, "--set", "features.pairs=12", "--set", "features.epochs=1"]
    assert call("fit", discs.file, "--target", images, "--out", tmp_path / "run", *words).code == 0
    for name in ("guide", "real"):
        (tmp_path / f"run/{name}.safetensors").unlink()
    next(images.iterdir()).unlink()
    done = call("fit", "--out", tmp_path / "run", "--resume")
    assert done.code == 2 and "as they were when the run began" in done.err and "Traceback" not in done.err
    assert not (tmp_path / "run/real.safetensors").exists()
