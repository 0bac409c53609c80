import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_two_steps_print_their_loss(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / "train_detector.py", "--steps", "2", "--batch-size", "2"],
        cwd=tmp_path, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    steps = re.findall(r"^step +(\d+) +\d+ objects  loss ([\d.]+)$", done.stdout, re.MULTILINE)
    assert [int(step) for step, _ in steps] == [0, 1] and all(float(loss) > 0 for _, loss in steps)
    assert not list(tmp_path.iterdir())
