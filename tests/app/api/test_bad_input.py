"""What a user brings that is wrong: one error that says what was expected, what came, and what to do."""

import re

import numpy as np
import pytest
import torch

import probscene as ps
from probscene.app.fitting.presets import QUICK

IMAGES = np.random.default_rng(0).integers(0, 256, (40, 64, 64, 3), np.uint8)


class Net:
    """Features that are right, but for what ``change`` makes of them."""

    names = ("mean", "spread")

    def __init__(self, change=lambda features: features):
        self.change = change

    def embed(self, images):
        pixels = images.float().flatten(1) / 16
        return self.change(torch.stack([pixels.mean(1), pixels.std(1)], 1))


class Table(ps.Guide):
    """A guide that is right, but for what ``change`` makes of its logits."""

    change = staticmethod(lambda logits: logits)

    def __init__(self, grammar, max_steps):
        super().__init__(grammar, max_steps)
        self.table = torch.nn.Parameter(torch.zeros(len(grammar.rules)))

    def step(self, memory, frontier, previous_rule):
        return self.change(self.table.expand(len(previous_rule), -1)), memory


def table(change):
    return type("Table", (Table,), {"change": staticmethod(change)})


class NoStep(Table):
    def step(self, memory, frontier, previous_rule):
        return self.table.expand(len(previous_rule), -1)


class Dropout(Table):
    def log_prob(self, derivation):
        return super().log_prob(derivation) + torch.rand(len(derivation))


class Nothing(ps.Guide):
    def step(self, memory, frontier, previous_rule):
        return torch.zeros(len(previous_rule), len(self.grammar.rules)), memory


class Loose(torch.nn.Module, ps.Policy):
    def __init__(self, grammar, max_steps):
        super().__init__()
        self.grammar, self.weight = grammar, torch.nn.Parameter(torch.zeros(1))


class Half:
    """Features without what every choice of features has."""

    name = "half"

    def build(self, model):
        return Net()


class NoNet(ps.Features):
    name = "no net"

    def build(self, model):
        return torch.nn.Linear(2, 2)


class OddSettings(ps.Features):
    name = "odd"

    def build(self, model):
        return Net()

    def settings(self, preset):
        return {"batchs": 3}


class OddDivergence(ps.Features):
    name = "odd"

    def build(self, model):
        return Net()

    def divergence(self, net, chosen):
        return lambda generated, real: chosen(generated, real).mean()


class NeedsMore:
    names = ("mean",)

    def __init__(self, size):
        pass

    def embed(self, images):
        return torch.zeros(len(images), 1)


def nan(x):
    return x * torch.nan


PARTS = {
    "columns": ({"features": Net(lambda x: x[:, :1])}, r"Net\.embed features .*\(N, D\).* got .* \(\d+, 1\)"),
    "rows": ({"features": Net(lambda x: x[0])}, r"Net\.embed .* got torch.float32 \(2,\)"),
    "whole numbers": ({"features": Net(lambda x: x.long())}, r"Net\.embed .* got torch.int64"),
    "numpy": ({"features": Net(lambda x: x.numpy())}, r"Net\.embed .* got ndarray"),
    "no features": ({"features": Net(lambda x: None)}, r"Net\.embed .* got NoneType"),
    "NaN features": ({"features": Net(nan)}, r"finite values of Net\.embed"),
    "random features": ({"features": Net(lambda x: x + torch.rand_like(x))}, r"Net\.embed to give .* the same"),
    "of the batch": ({"features": Net(lambda x: x - x.mean(0))}, r"Net\.embed to give .* the same .* alone"),
    "no network": ({"features": 5}, r"features with a name and build\(model\), .* got int"),
    "half of them": ({"features": Half()}, r"Half without training, adapt, .*; subclass probscene\.Features"),
    "built no network": ({"features": NoNet()}, r"NoNet\.build a network with names.* got Linear"),
    "odd settings": ({"features": OddSettings()}, r"paths .* OddSettings\.settings.* got 'batchs'"),
    "a class": ({"features": NeedsMore}, r"without arguments, got NeedsMore\(size\)"),
    "one cost": ({"divergence": lambda g, r: (g.mean() - r.mean()).abs()}, r"one cost a generated scene \(N,\).* \(\)"),
    "of features": ({"features": OddDivergence()}, r"one cost a generated scene \(N,\)"),
    "a cost a feature": ({"divergence": lambda g, r: g}, r"one cost a generated scene .* got .* \(\d+, \d\)"),
    "whole costs": ({"divergence": lambda g, r: g[:, 0].long()}, r"one cost .* got torch.int64"),
    "random costs": ({"divergence": lambda g, r: torch.rand(len(g))}, "<lambda> to give the same costs whenever"),
    "NaN costs": ({"divergence": lambda g, r: nan(g[:, 0])}, "finite values of <lambda>"),
    "no divergence": ({"divergence": 0.5}, r"a divergence, called with features .* got float"),
    "one argument": ({"divergence": lambda g: g}, r"a divergence, called with .* got <lambda>\(g\)"),
    "columns of logits": ({"guide": table(lambda x: x[:, 1:])}, r"Table\.step logits \(N, K\).* got .* \(4, 4\)"),
    "NaN logits": ({"guide": table(nan)}, r"finite values of Table\.step"),
    "whole logits": ({"guide": table(lambda x: x.long())}, r"Table\.step .* got torch.int64"),
    "no memory": ({"guide": NoStep}, r"\(logits, memory\) of NoStep\.step, got Tensor"),
    "random guide": ({"guide": Dropout}, r"Dropout\.log_prob to say the same"),
    "no parameters": ({"guide": Nothing}, r"parameters to learn, got Nothing with none"),
    "no guide": ({"guide": Loose}, r"a guide, got Loose; subclass probscene\.Guide"),
    "nothing made": ({"guide": lambda grammar, max_steps: None}, r"a guide, got NoneType"),
    "a guide's object": ({"guide": 3}, r"a class of guides or a function.* got int"),
    "of one argument": ({"guide": lambda grammar: None}, r"the grammar and max_steps, got <lambda>\(grammar\)"),
    "unknown features": ({"features": "cuont"}, "features among count, .*FILE.py:NAME, got 'cuont'"),
    "unknown divergence": ({"divergence": "kl"}, "a divergence among kde, .*FILE.py:NAME, got 'kl'"),
    "unknown guide": ({"guide": "gru"}, "a guide among lstm, .*FILE.py:NAME, got 'gru'"),
    "unknown preset": ({"preset": "fast"}, "a preset among quick, .* got 'fast'"),
    "unknown setting": ({"settings": {"batchs": 3}}, "a setting among .* got 'batchs'"),
    "setting of another type": ({"settings": {"structure.batches": 2.5}}, "structure.batches=<int>, got '2.5'"),
    "negative seed": ({"seed": -1}, "a seed of 0 or more, got -1"),
    "no threads": ({"threads": 0}, "a positive number of threads, got 0"),
}  # fmt: skip


@pytest.mark.parametrize("name", PARTS)
def test_parts_that_are_wrong(quick, discs, name):
    options, message = PARTS[name]
    short = {**discs.short, "features.schedule.steps": 2}
    with pytest.raises(ps.ProbsceneError, match=f"^(At batch 1 of 4: )?expected .*{message}"):
        quick(discs.file, IMAGES, **{"settings": short, "features": "count", **options})


class NoLength(torch.utils.data.IterableDataset):
    def __iter__(self):
        return iter(IMAGES)


class NoItems(NoLength):
    def __len__(self):
        return 40


TARGETS = {
    "channels first": (IMAGES.transpose(0, 3, 1, 2), r"image 0 as \(H, W\).* got uint8 \(3, 64, 64\)"),
    "floats": (IMAGES / 255, r"image 0 .* got float64 \(64, 64, 3\); convert it"),
    "floats above 1": (torch.tensor(IMAGES).permute(0, 3, 1, 2).float(), "floats from 0 to 1, got float32"),
    "one image": (IMAGES[0, :, :, 0], r"an array of images .* got shape \(64, 64\)"),
    "five axes": (IMAGES[None], r"an array of images .* got shape \(1, 40, 64, 64, 3\)"),
    "no images": (IMAGES[:0], "expected images to learn from, got none"),
    "few images": (IMAGES[:5], "at least 40 images in images in memory"),
    "one picture": (np.repeat(IMAGES[:1], 40, 0), "images that differ"),
    "empty list": ([], "got an empty list of files"),
    "no list of images": ([*IMAGES[:39], "39.png"], "expected image 39 .* got <U6"),
    "no length": (NoLength(), "a dataset with a length .* got NoLength"),
    "no items": (NoItems(), "images by number, got NoItems"),
    "a generator": ((image for image in IMAGES), "with a length .* got generator"),
    "a dictionary": (dict(enumerate(IMAGES)), "images by number, got dict"),
    "a set": ({"a.png", "b.png"}, "images by number, got set"),
    "nothing": (None, "expected a model and target images .* got one missing"),
    "a missing folder": ("nowhere", "got nowhere, which is not there"),
    "missing files": (["a.png", "b.png"], "got 2 of 2 bad: a.png cannot be read"),
}


@pytest.mark.parametrize("name", TARGETS)
def test_targets_that_are_wrong(quick, discs, name, tmp_path):
    images, message = TARGETS[name]
    with pytest.raises(ps.DataError, match=message):
        quick(discs.file, images, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


FILE = """
import torch
import probscene as ps

number = 5

class Needs:
    names = ("a",)
    def __init__(self, size): pass
    def embed(self, images): return torch.zeros(len(images), 1)

class Wrong:
    names = ("a", "b")
    def embed(self, images): return torch.zeros(len(images), 1)

def mean(generated, real): return generated.mean()

def broken(generated, real): return real[0, 99]

class Guide(ps.Guide):
    def __init__(self, grammar, max_steps):
        super().__init__(grammar, max_steps)
        self.weight = torch.nn.Parameter(torch.zeros(1))
    def step(self, memory, frontier, previous_rule): return torch.zeros(3), memory
"""
WORDS = {
    "no name": ("--features", "FILE.py:Nothing", "expected 'Nothing' in .*part.py, got none; write FILE.py:NAME"),
    "an empty name": ("--features", "FILE.py:", "expected '' in .*part.py, got none"),
    "no file": ("--guide", "nowhere.py:Guide", "expected a Python file, got '.*nowhere.py', which is not there"),
    "a file alone": ("--features", "FILE.py", "FILE.py:NAME, got '.*part.py'"),
    "a number as features": ("--features", "FILE.py:number", "got int; see probscene.Features"),
    "a number as divergence": ("--divergence", "FILE.py:number", "expected a divergence, .* got int"),
    "a number as guide": ("--guide", "FILE.py:number", "expected a class of guides .* got int"),
    "arguments": ("--features", "FILE.py:Needs", r"without arguments, got Needs\(size\)"),
    "features of a wrong shape": ("--features", "FILE.py:Wrong", r"Wrong\.embed .*\(40, 2\), got .*\(40, 1\)"),
    "one cost": ("--divergence", "FILE.py:mean", r"expected of mean one cost a generated scene"),
    "an error in it": ("--divergence", "FILE.py:broken", r"IndexError in .*part.py, line \d+: index 99 .*--debug"),
    "logits": ("--guide", "FILE.py:Guide", r"expected of Guide\.step logits \(N, K\)"),
    "syntax": ("--guide", "broken.py:Guide", r"broken.py does not import: SyntaxError"),
}


@pytest.mark.parametrize("name", WORDS)
def test_the_command_line_says_it_in_one_line(call, discs, target, tmp_path, name, monkeypatch):
    option, word, message = WORDS[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.py").write_text(FILE)
    (tmp_path / "broken.py").write_text("def f(:\n")
    settings = discs.without("features") if option == "--features" else discs.settings
    short = [*settings, option, word.replace("FILE", "part")]
    done = call("fit", discs.file, "--target", target.images, "--out", tmp_path / "run", *short)
    (line,) = [line for line in done.err.splitlines() if line.startswith("probscene: ")]
    assert done.code == 2 and "Traceback" not in done.err
    assert re.search(message, line), line
    if name not in ("features of a wrong shape", "one cost", "an error in it"):  # which are found in the fit
        assert not (tmp_path / "run").exists()


def test_a_file_named_by_a_setting_is_found_from_everywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = QUICK.set("guide=part.py:Guide")
    assert config.guide == f"{tmp_path.resolve() / 'part.py'}:Guide"
