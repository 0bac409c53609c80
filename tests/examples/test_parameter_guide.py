"""The example of a parameter guide learns where mugs stand."""

import re
from pathlib import Path

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "parameter_guide.py"


def test_it_learns_where_mugs_stand(tmp_path, monkeypatch, script):
    monkeypatch.chdir(tmp_path)
    done = script(EXAMPLE, "--steps", "60")
    assert done.returncode == 0, done.stderr
    found = dict(re.findall(r"mug.dx, (\w+): ([\d.]+) pixels", done.stdout))
    assert float(found["learnt"]) < float(found["prior"]) / 4
