"""A detector as ONNX gives what torch gives."""

import shutil

import numpy as np
import pytest
import torch

from probscene.app.detectors.folder import ONNX, WEIGHTS
from probscene.app.detectors.train import train
from probscene.app.trial.sets import read_set
from probscene.app.trial.training import fitted
from probscene.decoding import read_rgb
from probscene.errors import MachineError, ProbsceneError

from .conftest import small_options


def test_onnx_gives_the_same_boxes_and_scores(trained, discs, photographs, tmp_path):
    """It is written when it is asked for, also of a detector that is there already."""
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name, reason=f"the package {name} is not installed: pip install 'probscene[test]'")
    import onnxruntime

    out = tmp_path / "out"
    shutil.copytree(trained.path, out)
    train(discs.file, photographs / "train", None, out, small_options(test=photographs / "test", onnx=True))
    assert (out / WEIGHTS).read_bytes() == (trained.path / WEIGHTS).read_bytes()
    session = onnxruntime.InferenceSession(out / ONNX, providers=["CPUExecutionProvider"])
    for example in read_set(photographs / "test").examples:
        small, _ = fitted(read_rgb(example.path), trained.size)
        image = small.transpose(2, 0, 1).astype(np.float32) / 255
        with torch.no_grad():
            found = trained.network([torch.from_numpy(image)])[0]
        boxes, labels, scores = session.run(["boxes", "labels", "scores"], {"image": image})
        number = len(found["scores"])
        assert number > 0 and not scores[number:].any()
        np.testing.assert_allclose(scores[:number], found["scores"].numpy(), atol=1e-4)
        np.testing.assert_allclose(boxes[:number], found["boxes"].numpy(), atol=1e-2)
        np.testing.assert_array_equal(labels[:number], found["labels"].numpy())


def test_what_it_needs_is_said_before_anything_is_trained(discs, tmp_path, monkeypatch):
    monkeypatch.setattr("probscene.app.detectors.export.find_spec", lambda name: None if name == "onnx" else name)
    with pytest.raises(MachineError, match=r"got no onnx; install them with pip install 'probscene\[onnx\]'"):
        train(discs.file, None, None, tmp_path / "out", small_options(onnx=True))
    monkeypatch.setattr("probscene.app.detectors.train.recipe_of", lambda *_: None)
    with pytest.raises(ProbsceneError, match="efficientnet for --onnx, got 'maskrcnn=x'"):
        train(discs.file, None, None, tmp_path / "out", small_options(onnx=True, detector="maskrcnn=x"))
    assert not (tmp_path / "out").exists()
