"""Fits from Python of the discs, each in about a second."""

from collections.abc import Callable

import pytest

import probscene as ps
from probscene.app.fitting.config import configuration


@pytest.fixture(scope="session")
def quick(discs) -> Callable[..., ps.Run]:
    """``ps.fit`` with a quick preset, made shorter, one thread and no cache, unless said otherwise: options of
    ``configuration`` and ``TargetImages`` are its own."""

    def fit(model, target, preset="quick", settings=discs.short, threads=1, skip_bad=None, **options):
        chosen = {"features": "count", "parameters": "none"} if isinstance(preset, str) else {}
        chosen |= {name: options.pop(name) for name in ("features", "divergence", "guide") if name in options}
        if chosen.get("features", "count") != "count" and isinstance(settings, dict):
            settings = {key: value for key, value in settings.items() if not key.startswith("features.schedule.")}
            settings.pop("features.width", None)
        preset = ps.preset(preset) if isinstance(preset, str) else preset
        config = configuration(preset, **chosen, settings=settings)
        images = ps.TargetImages(target, skip_bad)
        execution = ps.Execution(threads, cache=False, progress=False)
        return ps.fit(model, images, config, execution=execution, **options)

    return fit


@pytest.fixture(scope="session")
def python_run(quick, discs, target, tmp_path_factory) -> ps.Run:
    """A finished fit of a model's file, from Python."""
    return quick(discs.file, target.images, out=tmp_path_factory.mktemp("python") / "run")
