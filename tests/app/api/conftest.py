"""Fits from Python of the discs, each in about a second."""

from collections.abc import Callable

import pytest

import probscene as ps


@pytest.fixture(scope="session")
def quick(discs) -> Callable[..., ps.Run]:
    """``ps.fit`` with a quick preset, made shorter, one thread and no cache, unless said otherwise."""

    def fit(model, target, **options):
        short = {"preset": "quick", "settings": discs.short, "features": "count", "learn": "structure"}
        short |= {"threads": 1, "cache": False, "progress": False}
        return ps.fit(model, target, **{**short, **options})

    return fit


@pytest.fixture(scope="session")
def python_run(quick, discs, target, tmp_path_factory) -> ps.Run:
    """A finished fit of a model's file, from Python."""
    return quick(discs.file, target.images, out=tmp_path_factory.mktemp("python") / "run")
