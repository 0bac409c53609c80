"""A cluster for tests."""

import pytest

from .simulated import Simulated


@pytest.fixture(scope="module")
def _simulated():
    simulated = Simulated()
    yield simulated
    simulated.shutdown()


@pytest.fixture
def simulated(_simulated):
    _simulated.whole()
    return _simulated
