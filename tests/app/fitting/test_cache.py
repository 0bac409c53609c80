"""Trained feature networks in the cache: found again under all that they depend on, and only then."""

import json
import shutil
from dataclasses import replace

import pytest
import torch

import probscene as ps
from probscene.app.fitting.cache import NetworkCache
from probscene.app.fitting.store import state_of

FILES = ("features.safetensors", "real.safetensors", "guide.safetensors", "log.jsonl")


@pytest.fixture(scope="module")
def words(discs):
    return [word for word in discs.settings if word != "--no-cache"]


@pytest.fixture
def fit(call, words, target, tmp_path):
    """``fit(model, *words)`` by the command line with a cache: the run, and whether its network came from there."""
    number = iter(range(100))

    def fitted(model, *more, cache=tmp_path / "cache", words=words):
        out = tmp_path / f"run{next(number)}"
        done = call("fit", model, "--target", target.images, "--out", out, *words, "--cache", cache, *more)
        assert done.code == 0, done.err
        return ps.Run.open(out), "was trained before" in " ".join(done.err.split())

    return fitted


@pytest.fixture
def whole(fit, discs, tmp_path, whole_cache):
    """A cache that holds the discs' network."""
    shutil.copytree(whole_cache, tmp_path / "cache")
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def whole_cache(call, discs, words, target, tmp_path_factory):
    folder = tmp_path_factory.mktemp("networks")
    out = folder / "run"
    done = call("fit", discs.file, "--target", target.images, "--out", out, *words, "--cache", folder / "cache")
    assert done.code == 0 and "trained before" not in done.err
    return folder / "cache"


def same(run, other):
    return all((run.path / name).read_bytes() == (other / name).read_bytes() for name in FILES)


def test_the_second_fit_takes_it_and_has_the_same_bytes(fit, discs, whole, fitted):
    """As a fit with --no-cache has."""
    run, taken = fit(discs.file)
    assert taken and same(run, fitted)
    assert len(list((whole / "features").iterdir())) == 2
    assert ps.Run.open(run.path).evaluate(num=50, progress=False).record()


def test_python_takes_it_too(discs, target, whole, fitted, capsys):
    config, execution = (
        ps.preset("quick").set("features=count", "parameters=none", discs.short),
        ps.Execution(threads=1, cache=whole),
    )
    run = ps.fit(discs.file, target.images, config, execution=execution)
    assert "was trained before" in " ".join(capsys.readouterr().err.split()) and same(run, fitted)


def test_what_learns_from_it_does_not_matter(fit, discs, whole):
    for more in (["--guide", "pcfg"], ["--divergence", "witness"], ["--set", "structure.batches=2"]):
        assert fit(discs.file, *more)[1], more


def test_another_network_is_another_entry(fit, discs, whole):
    words = [word for word in discs.without("parameters", "features") if word != "--no-cache"]
    words += ["--learn", "structure", "--features", "presence"]
    words += ["--set", "features.images=40", "--set", "features.epochs=1"]
    assert not fit(discs.file, words=words)[1]
    assert fit(discs.file, words=words)[1]
    assert len(list((whole / "features").glob("*.safetensors"))) == 2


@pytest.mark.parametrize("setting", ["features.schedule.steps=40", "features.width=4,4,8"])
def test_another_setting_of_the_network_is_another_entry(python_of, setting):
    run, net = python_of
    other = type(run)(run.path, run.record, run.model)
    other.config = run.config.set(setting)
    assert NetworkCache(other, net).key != NetworkCache(run, net).key


def test_another_file_is_another_entry(fit, discs, whole, tmp_path):
    model = tmp_path / "discs.py"
    model.write_text(discs.file.read_text())
    assert not fit(model)[1] and fit(model)[1]
    model.write_text(discs.file.read_text() + "\n# radius\n")
    assert not fit(model)[1]


PART = """
from pathlib import Path

import torch
import probscene as ps
from probscene.inference.features.presence import PresenceNet, PresenceTraining

class Own(ps.Features):
    name = "own"

    def build(self, model):
        net = PresenceNet(model.classes, 2, 4)
        with torch.no_grad():
            net.out.bias.fill_(float(Path({weights!r}).read_text()))
        return net

    def training(self, net, renders, photographs, seed):
        return PresenceTraining(net, renders.draw, 20, 1, seed=seed)
"""


def test_features_in_a_file_are_known_by_its_bytes_and_their_weights(fit, discs, tmp_path):
    part, weights = tmp_path / "part.py", tmp_path / "weights"
    part.write_text(PART.format(weights=str(weights)))
    weights.write_text("0.5")
    own = ["--features", f"{part}:Own"]
    words = [word for word in discs.without("features", "parameters") if word != "--no-cache"]
    words += ["--learn", "structure"]
    assert not fit(discs.file, *own, words=words)[1] and fit(discs.file, *own, words=words)[1]
    weights.write_text("0.25")  # as where pretrained ones are another version's
    assert not fit(discs.file, *own, words=words)[1]
    part.write_text(part.read_text() + "\n# changed\n")
    assert not fit(discs.file, *own, words=words)[1]


@pytest.mark.parametrize(
    ("name", "value"), [("assets", "digits of another folder"), ("model_sha256", "0"), ("threads", 3), ("seed", 1)]
)
def test_what_a_run_records_makes_another_entry(python_of, name, value):
    run, net = python_of
    other = type(run)(run.path, run.record | {name: value}, run.model)
    assert NetworkCache(other, net).key != NetworkCache(run, net).key


def test_the_target_that_a_network_learns_from_makes_another_entry(python_of, tmp_path):
    run, net = python_of
    key = NetworkCache(run, net).key
    assert NetworkCache(run, net, target="1f").key != key
    assert NetworkCache(run, net, tmp_path).key == key


def test_a_folder_of_assets_is_known_by_all_that_it_holds(python_of, tmp_path, monkeypatch):
    run, net = python_of
    folder = tmp_path / "assets"
    folder.mkdir()
    drawn = type(run)(run.path, run.record | {"assets_folder": str(folder)}, run.model)
    keys = []
    for content in ("one", "other", "one"):
        (folder / "picture").write_text(content)
        keys.append(NetworkCache(drawn, net).key)
    assert keys[0] == keys[2] != keys[1]
    monkeypatch.setenv("DISCS", str(folder))
    named = type(run)(run.path, run.record, replace(run.model, assets_variable="DISCS", with_assets=str))
    key = NetworkCache(named, net).key
    (folder / "picture").rename(folder / "photo")
    assert NetworkCache(named, net).key != key


@pytest.fixture
def python_of(fitted):
    run = ps.Run.open(fitted)
    return run, run.build_network()


def damages():
    def cut(file, log):
        file.write_bytes(file.read_bytes()[:-10])

    def flip(file, log):
        data = bytearray(file.read_bytes())
        data[-7] ^= 1
        file.write_bytes(data)

    def empty(file, log):
        file.write_bytes(b"")

    def no_log(file, log):
        log.unlink()

    def cut_log(file, log):
        log.write_text(log.read_text()[:-5])

    def odd_log(file, log):
        log.write_bytes(b"\xff\xfe")

    return [cut, flip, empty, no_log, cut_log, odd_log]


@pytest.mark.parametrize("damage", damages(), ids=lambda each: each.__name__)
def test_a_damaged_one_is_as_if_it_were_not_there_and_is_mended(python_of, tmp_path, damage):
    run, net = python_of
    cache, tensors, lines = NetworkCache(run, net, tmp_path), state_of(net), ["one", "other"]
    cache.save(tensors, lines)
    damage(cache.file, cache.file.with_suffix(".jsonl"))
    assert cache.load() is None
    cache.save(tensors, lines)
    found = cache.load()
    assert found.lines == lines and all(torch.equal(found.tensors[name], tensors[name]) for name in tensors)


def test_a_damaged_one_is_trained_anew(fit, discs, whole, fitted):
    (file,) = (whole / "features").glob("*.safetensors")
    file.write_bytes(b"")
    run, taken = fit(discs.file)
    assert not taken and same(run, fitted)
    assert fit(discs.file)[1]


def test_a_cache_that_cannot_be_written_does_no_harm(fit, discs, fitted, tmp_path, monkeypatch):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file is in the way")
    run, taken = fit(discs.file, cache=blocked)
    assert not taken and same(run, fitted) and blocked.read_text()
    monkeypatch.setattr("probscene.app.files.os.access", lambda path, mode: "deep" not in str(path))
    run, taken = fit(discs.file, cache=tmp_path / "cache" / "deep")
    assert not taken and same(run, fitted) and not list((tmp_path / "cache" / "deep").rglob("*.safetensors"))


def test_models_and_features_in_memory_are_not_kept(discs, target, tmp_path):
    model = replace(ps.load_model(discs.file), name="in memory")
    execution = ps.Execution(threads=1, progress=False, cache=tmp_path / "cache")
    ps.fit(
        model,
        target.images,
        ps.preset("quick").set("features=count", "parameters=none", discs.short),
        execution=execution,
    )
    assert not (tmp_path / "cache").exists()


def test_a_log_is_taken_with_its_network(fit, discs, whole):
    run, _ = fit(discs.file)
    (log,) = (whole / "features").glob("*.jsonl")
    digest, *lines = log.read_text().splitlines()
    assert set(json.loads(digest)) == {"sha256"}
    assert lines == [line for line in (run.path / "log.jsonl").read_text().splitlines() if '"features"' in line]
