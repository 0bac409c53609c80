"""A detector as ONNX gives what torch gives."""

import numpy as np
import pytest
import torch

from probscene.app.detectors.export import export
from probscene.app.detectors.folder import ONNX
from probscene.app.detectors.train import train
from probscene.app.trial.sets import read_set
from probscene.app.trial.training import fitted
from probscene.decoding import read_rgb

from .conftest import small_options

pytest.importorskip("onnx", reason="the package onnx is not installed: pip install 'probscene[onnx]'")
pytest.importorskip("onnxscript", reason="the package onnxscript is not installed: pip install 'probscene[onnx]'")
onnxruntime = pytest.importorskip("onnxruntime", reason="the package onnxruntime, which runs ONNX, is not installed")


def test_onnx_gives_the_same_boxes_and_scores(trained, photographs, tmp_path):
    export(trained.network, trained.size, tmp_path / "detector.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "detector.onnx", providers=["CPUExecutionProvider"])
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


def test_it_is_written_when_asked_for_also_later(discs, tmp_path):
    options = small_options()
    train(discs.file, None, None, tmp_path / "out", options)
    weights = (tmp_path / "out" / "detector.safetensors").stat().st_mtime_ns
    train(discs.file, None, None, tmp_path / "out", small_options(onnx=True))
    assert (tmp_path / "out" / ONNX).stat().st_size > 10**6
    assert (tmp_path / "out" / "detector.safetensors").stat().st_mtime_ns == weights
