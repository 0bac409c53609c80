import importlib

import pytest

from probscene.app.run import Run
from probscene.errors import RunError
from probscene.models import multi_mnist


def test_a_run_is_bound_to_the_digits_it_was_begun_with(tmp_path, monkeypatch):
    monkeypatch.delenv("PROBSCENE_MNIST", raising=False)
    importlib.reload(multi_mnist)
    run = Run.create(tmp_path / "run", "multi_mnist", {})
    assert Run.open(run.path).model.name == "multi_mnist"
    monkeypatch.setenv("PROBSCENE_MNIST", str(tmp_path))
    importlib.reload(multi_mnist)
    with pytest.raises(RunError, match="PROBSCENE_MNIST"):
        _ = Run.open(run.path).model
    monkeypatch.delenv("PROBSCENE_MNIST")
    importlib.reload(multi_mnist)
