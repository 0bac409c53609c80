"""What the README shows is run, and the commands that it names exist."""

import re
from pathlib import Path

from typer.testing import CliRunner

from probscene.app.cli import app
from probscene.model import SceneModel
from probscene.sampling import sample

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def test_python_examples_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) == 3
    for block in blocks:
        names = {}
        exec(compile(block, "README.md", "exec"), names)
    assert "torch.Size([16, 3, 256, 256])" in capsys.readouterr().out
    model = next(value for value in names.values() if isinstance(value, SceneModel))
    assert len(sample(model, model.prior, 3).drawing) == 3


def test_commands_exist():
    named = set(re.findall(r"^    probscene (\w+)", README, re.MULTILINE))
    assert named == {"check", "preview", "view", "fit", "generate", "evaluate", "report", "compare"}
    for command in named:
        assert CliRunner().invoke(app, [command, "--help"]).exit_code == 0


def test_files_it_names_are_there():
    root = Path(__file__).resolve().parents[1]
    for name in re.findall(r"(?:examples|benchmarks|inference)/\w+\.\w+", README):
        assert (root / name).is_file(), name
