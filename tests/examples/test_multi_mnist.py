import re
from pathlib import Path

import pytest

from probscene.inference.pretrain import pretrain

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "multi_mnist.py"
FEW = ["--batches", "2", "--num-scenes", "40", "--num-real", "100"]


@pytest.mark.parametrize("arguments", [["--oracle"], ["--steps", "16"]], ids=["oracle", "pixels"])
def test_runs_and_prints_how_far_it_came(arguments, tmp_path, monkeypatch, script):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pretrain, "__defaults__", (100, 1, *pretrain.__defaults__[2:]))  # derivations and epochs
    done = script(EXAMPLE, *arguments, *FEW)
    assert done.returncode == 0, done.stderr
    distances = re.findall(r"total variation, (\w+): number of digits ([\d.]+), classes ([\d.]+)", done.stdout)
    assert [name for name, *_ in distances] == ["prior", "learnt"]
    assert all(0 <= float(value) <= 1 for _, *pair in distances for value in pair)
