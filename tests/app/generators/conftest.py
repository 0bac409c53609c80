"""A model with a generator, its scenes, and what its workers leave."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from probscene.app.loading import load_model
from probscene.renderers.generator.pool import close_pools
from probscene.renderers.generator.renderer import GeneratedRenderer
from probscene.sampling import sample, seed_everything


@pytest.fixture(scope="session")
def model():
    return load_model(str(Path(__file__).with_name("boxes.py")))


@pytest.fixture
def command(model):
    """The model's command, with other settings."""
    return lambda **more: replace(model.generator, **more)


@pytest.fixture
def request_of(model):
    """A request of so many scenes."""

    def make(number, seed=0):
        seed_everything(seed)
        return sample(model, model.prior, number).drawing

    return make


@pytest.fixture
def drawn(command):
    """What two workers of the command, with other settings, make of a request."""
    return lambda request, **more: GeneratedRenderer(command(**more), (32, 40), threads=2)(request)


@pytest.fixture
def fault(monkeypatch, tmp_path):
    """Lets workers that start from now on fail in a way, once for every third scene."""

    def let(name):
        monkeypatch.setenv("TEST_FAULT", name)
        monkeypatch.setenv("TEST_MARK", str(tmp_path))

    return let


@pytest.fixture(autouse=True)
def no_pools():
    """Each test has pools of its own."""
    yield
    close_pools()


@pytest.fixture
def fresh():
    """Ends all workers."""
    return close_pools


@pytest.fixture
def running():
    """The processes of a group that have not ended."""
    return processes_of


def processes_of(group):
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, _, its_group = (folder / "stat").read_text().rpartition(")")[2].split()[:3]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(its_group) == group and state != "Z":
            found.append(int(folder.name))
    return found


@pytest.fixture
def same():
    """Whether two batches hold the same bytes."""
    return lambda one, other: all(torch.equal(a, b) for a, b in zip(one[:7], other[:7], strict=True))
