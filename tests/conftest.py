"""What every test has: one thread, a seed, an empty parameter store, and outside data where there is any."""

import os
from hashlib import sha256
from pathlib import Path

import pyro
import pytest
import torch
from hypothesis import HealthCheck, settings

CI = os.environ.get("CI") == "true"
# Files that take longest, first.
LONG = (
    "test_cluster.py", "test_stochastic_em.py", "test_engine.py", "test_parameters.py", "test_joint_parameters.py",
    "test_pretrained_fit.py", "test_meshes.py", "test_interrupted.py", "test_docs.py",
)  # fmt: skip

torch.set_num_threads(1)
settings.register_profile(
    "probscene",
    deadline=None,
    max_examples=6 if CI else 25,  # the same in each run of CI, others elsewhere
    derandomize=CI,
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],  # both judge the machine's load, too
)
settings.load_profile("probscene")


def pytest_collection_modifyitems(items):
    """Long files first, so that no worker is left with one while the other has nothing to do."""
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))


@pytest.fixture(autouse=True)
def _fresh_pyro():
    pyro.set_rng_seed(0)  # torch, numpy and random
    pyro.clear_param_store()


_SEEN = {}  # of each picture what EfficientNet makes of it


def _seen_once(name):
    """A method of EfficientNet that computes nothing anew for a picture that it has had before."""
    from probscene.inference.features.pretrained import EfficientNetLite

    method = getattr(EfficientNetLite, name)

    def found(net, images):
        keys = [(name, net.size, image.shape, sha256(image.numpy().tobytes()).digest()) for image in images]
        new = [i for i, key in enumerate(keys) if key not in _SEEN]
        if new:
            _SEEN.update(zip((keys[i] for i in new), zip(*method(net, images[new]), strict=True), strict=True))
        return tuple(map(torch.stack, zip(*(_SEEN[key] for key in keys), strict=True)))

    return found


@pytest.fixture(scope="module")
def few_and_small_images():
    """A verdict looks at these; EfficientNet takes a fifth of the pixels, which tells small scenes apart as well, and
    sees each picture once."""
    from probscene.inference.features.pretrained import EfficientNetLite

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EfficientNetLite.__init__, "__defaults__", (96,))
        for name in ("places", "looks"):
            patch.setattr(EfficientNetLite, name, _seen_once(name))
        patch.setattr("probscene.app.evaluation.source_features.NUM_IMAGES", 60)
        patch.setattr("probscene.app.evaluation.diagnose.NUM_SCENES", 60)
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of outside data: ``PROBSCENE_DATA``, or ``shared/data`` beside the checkout."""
    named = os.environ.get("PROBSCENE_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no outside data in {folder}; name its folder in PROBSCENE_DATA")
    return folder
