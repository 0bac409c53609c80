"""A run that generates, and what it writes undisturbed."""

import json
from pathlib import Path

import pytest
import torch

from probscene.app.datasets.generate import generate
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model
from probscene.grammar import Rule
from probscene.inference.guides.lstm import LSTMGuide

PLATES = Path(__file__).parents[1] / "plates.py"
GUIDE = {"hidden": 8}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder, by its relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "provenance.jsonl").read_text(encoding="utf-8").splitlines()]


def a_run(path: Path, plates: float) -> RunFolder:
    """A run with a guide that nothing has taught; ``plates`` is a bias towards more of them."""
    run = RunFolder.create(path, str(PLATES), {"guide": GUIDE})
    guide = LSTMGuide(run.model.grammar, run.model.max_steps, **GUIDE)
    guide.out.bias.data[run.model.grammar.rules.index(Rule("Plates", "Plate", "Plates"))] += plates
    run.write_tensors("guide", guide.state_dict())
    return run


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> RunFolder:
    torch.manual_seed(0)
    return a_run(tmp_path_factory.mktemp("run") / "run", 0.5)


@pytest.fixture(scope="module")
def model():
    return load_model(str(PLATES))


@pytest.fixture(scope="module")
def undisturbed(run, tmp_path_factory) -> Path:
    """130 images: two chunks and two images of a third."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    generate(run, 130, out, seed=3)
    return out
