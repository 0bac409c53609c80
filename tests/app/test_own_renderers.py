"""A model's own renderer: the first batch that it gives is checked, and each fault is named."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from probscene.app.loading import load_model, renderer_for
from probscene.batch import SceneGeometry
from probscene.errors import ModelError
from probscene.renderers.sprites import SpriteRenderer
from probscene.sampling import sample, seed_everything
from probscene.scenarios import join
from probscene.structure import StructurePrior, counts


class Flawed:
    """The built-in renderer, whose batches a function changes."""

    def __init__(self, canvas, threads, change=lambda batch: batch):
        self.inner, self.change, self.calls = SpriteRenderer(canvas, threads), change, 0

    def __call__(self, drawing):
        self.calls += 1
        return self.change(self.inner(drawing))


@pytest.fixture(scope="module")
def model():
    return load_model(str(Path(__file__).with_name("discs.py")))


@pytest.fixture
def drawing(model):
    seed_everything(0)
    return sample(model, StructurePrior(model.grammar, Discs=counts(0, 0, 0, 1)), 5).drawing


def own(model, change):
    return replace(model, renderer=lambda canvas, threads: Flawed(canvas, threads, change))


def test_it_is_called_with_the_canvas_and_the_threads_and_gives_what_it_gives(model, drawing):
    made = []

    def make(canvas, threads):
        made.append((canvas, threads, Flawed(canvas, threads)))
        return made[-1][-1]

    render = renderer_for(replace(model, renderer=make), threads=1)
    batch, plain = render(drawing), renderer_for(model, threads=1)(drawing)
    assert made[0][:2] == ((64, 64), 1) and made[0][2].calls == 2  # the first scene once more
    assert all(torch.equal(one, other) for one, other in zip(batch[:7], plain[:7], strict=True)) and batch.space is None
    render(drawing[1:3])
    assert made[0][2].calls == 3
    assert renderer_for(own(model, lambda batch: batch))(drawing[:0]).image.shape == (0, 3, 64, 64)


def set_(key, change):
    return lambda batch: batch._replace(**{key: change(getattr(batch, key).clone())})


def put(value, *place):
    def change(tensor):
        tensor[place] = value
        return tensor

    return change


def without_labels(batch):
    return batch._replace(kind=torch.full_like(batch.kind, -1))


def in_space(batch, **more):
    N, M, (H, W) = *batch.kind.shape, batch.image.shape[2:]
    sky, nothing = torch.zeros(N, H, W, dtype=torch.uint8), torch.zeros(N, M)
    space = SceneGeometry(torch.ones(N, H, W), sky, ("sky",), nothing, torch.zeros(N, M, 7), torch.zeros(N, 3, 3))
    return batch._replace(space=space._replace(**more))


class Noise:
    def __init__(self):
        self.calls = 0

    def __call__(self, batch):
        self.calls += 1
        return batch._replace(image=batch.image + (self.calls > 1))


FAULTS = {
    "no batch": (lambda batch: batch.image, "a RenderBatch .* got Tensor"),
    "nothing": (lambda batch: None, "a RenderBatch .* got NoneType"),
    "array": (set_("image", lambda image: image.numpy()), "image as a tensor of torch.uint8 .* got ndarray"),
    "channels last": (set_("image", lambda image: image.permute(0, 2, 3, 1)), r"image as torch.uint8 \(5, 3, 64, 64\)"),
    "floats": (set_("image", lambda image: image / 255), "image as torch.uint8 .* got torch.float32"),
    "canvas": (set_("image", lambda image: image[..., :32]), r"got torch.uint8 \(5, 3, 64, 32\)"),
    "one scene": (set_("image", lambda image: image[:1]), r"got torch.uint8 \(1, 3, 64, 64\)"),
    "fewer nodes": (set_("kind", lambda kind: kind[:, :2]), r"kind as torch.int64 \(5, 3\) .* got .* \(5, 2\)"),
    "doubles": (set_("box", lambda box: box.double()), "box as torch.float32 .* got torch.float64"),
    "ids": (set_("instance", put(9, 0, 0, 0)), r"instance in 0..3, .* got 0..9"),
    "another kind": (set_("kind", put(5, 0, 0)), "kind as the drawing's, .* got 5 where the drawing has"),
    "no kind": (without_labels, "ids of nodes that kind labels, got pixels of a node whose kind is -1"),
    "pixels": (set_("pixels", put(5, 0, 0)), "pixels as instance has them"),
    "visible": (set_("visible", lambda visible: visible * 100), r"visible in 0..1, .* got .*\.\.100"),
    "NaN": (set_("visible", put(float("nan"), 1, 1)), "visible without NaN"),
    "width": (set_("box", lambda box: box[..., [0, 1, 3, 2]]), "box as x0, y0, x1, y1 on the canvas of 64 x 64 pixels"),
    "beyond": (set_("box", lambda box: box + 60), "box as x0, y0, x1, y1 on the canvas"),
    "amodal": (set_("amodal_box", lambda box: box[..., [2, 3, 0, 1]]), "amodal_box as x0, y0, x1, y1 with x0 <= x1"),
    "no space": (lambda batch: batch._replace(space=(1,)), "a Space as space, or None, got tuple"),
    "depth": (lambda batch: in_space(batch, depth=torch.ones(5, 64)), r"space.depth as torch.float32 \(5, 64, 64\)"),
    "names": (lambda batch: in_space(batch, names=()), r"semantic below the number of space.names \(0\), got 0"),
    "noise": (Noise(), "bytes whenever it renders a scene, .* got another image in a second call"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_a_renderer_must_not_return(fault, model, drawing):
    change, message = FAULTS[fault]
    with pytest.raises(ModelError, match=f"expected Flawed.__call__ to (return|give the) .*{message}"):
        renderer_for(own(model, change), threads=1)(drawing)


def test_a_space_that_is_right_passes(model, drawing):
    batch = renderer_for(own(model, in_space), threads=1)(drawing)
    assert batch.space.names == ("sky",)


def test_a_function_is_called_by_its_name(model, drawing):
    def night(drawing):
        return 5

    with pytest.raises(ModelError, match="expected .*night to return a RenderBatch .* got int"):
        renderer_for(replace(model, renderer=lambda canvas, threads: night))(drawing)


def test_a_renderer_that_is_none(model):
    with pytest.raises(ModelError, match="called with the canvas and a number of threads, to give .* got NoneType"):
        renderer_for(replace(model, renderer=lambda canvas, threads: None))


def test_scenarios_have_one_renderer(model):
    night = replace(model, renderer=Flawed)
    assert join("both", {"one": night, "other": night}).renderer is Flawed
    with pytest.raises(ModelError, match="scenarios of one renderer"):
        join("both", {"one": model, "other": night})
