import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_two_steps_print_their_loss(tmp_path, monkeypatch, script):
    monkeypatch.chdir(tmp_path)
    done = script(ROOT / "examples" / "train_detector.py", "--steps", "2", "--batch-size", "2")
    assert done.returncode == 0, done.stderr
    steps = re.findall(r"^step +(\d+) +\d+ objects  loss ([\d.]+)$", done.stdout, re.MULTILINE)
    assert [int(step) for step, _ in steps] == [0, 1] and all(float(loss) > 0 for _, loss in steps)
    assert not list(tmp_path.iterdir())
