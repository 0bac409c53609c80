"""A cluster, whatever was done to its nodes before."""

from pathlib import Path

import pytest

from probscene.app.modules import import_file

SIMULATED = Path(__file__).parents[3] / "benchmarks" / "simulated_cluster.py"


@pytest.fixture(scope="module")
def _simulated():
    pytest.importorskip("ray")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")  # 15 otherwise: other tests on the same cores would go before
        simulated = import_file(SIMULATED).Simulated()
        yield simulated
        simulated.shutdown()


@pytest.fixture
def simulated(_simulated):
    """With one node at least; a test that needs more asks for them, as each takes seconds to start."""
    _simulated.whole(1)
    return _simulated
