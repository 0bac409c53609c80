"""What the README shows is run, and what it names is there."""

import functools
import re
from pathlib import Path

import yaml
from typer.testing import CliRunner

import probscene as ps
from probscene.app.cli import app
from probscene.app.datasets.generate import generate_scenes
from probscene.models.multi_mnist import MODEL

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TINY = {"parameters": "none", "features": "count", "features.schedule.steps": 8, "structure.batches": 1}
TINY |= {"structure.num_scenes": 20, "pretrain.derivations": 100}
TINY |= {"pretrain.epochs": 1}


def test_python_runs(tmp_path, monkeypatch, capsys):
    """With a fit that learns next to nothing, from images that the model has drawn."""
    generate_scenes(MODEL, MODEL.prior, 60, tmp_path, format="images")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PROBSCENE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("probscene.app.evaluation.source_features.NUM_IMAGES", 40)
    fit = ps.fit

    def tiny(model, target, config, **options):
        return fit(model, target, ps.preset(config).set(TINY), **options)

    monkeypatch.setattr(ps, "fit", tiny)
    monkeypatch.setattr(ps.Run, "report", functools.partialmethod(ps.Run.report, num=200, scenes=60))
    (block,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names = {}
    exec(compile(block, "README.md", "exec"), names)
    assert "torch.Size([16, 3, 256, 256])" in capsys.readouterr().out
    assert (tmp_path / "dataset" / "annotations.json").is_file()
    assert len(names["target"]["boxes"]) == len(names["target"]["labels"])


def test_the_citation_is_of_this_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (cited["cff-version"], cited["version"]) == ("1.2.0", ps.__version__)
    assert {"message", "title", "authors", "references"} <= cited.keys()


def test_it_is_short():
    assert len(README.splitlines()) <= 110


def test_commands_exist():
    named = re.findall(r"^    probscene +(\w+)", README, re.MULTILINE)
    assert len(named) == 4
    for command in named:
        assert CliRunner().invoke(app, [command, "--help"]).exit_code == 0


def test_files_it_names_are_there():
    for name in re.findall(r"\]\((?!https?:)([^)#]+)", README):
        assert (ROOT / name).is_file(), name
