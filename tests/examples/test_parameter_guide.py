"""The example of a parameter guide learns where mugs stand."""

import os
import re
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "parameter_guide.py"


def test_it_learns_where_mugs_stand(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLE.parents[1]), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, EXAMPLE, "--steps", "60"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    found = dict(re.findall(r"mug.dx, (\w+): ([\d.]+) pixels", done.stdout))
    assert float(found["learnt"]) < float(found["prior"]) / 4
