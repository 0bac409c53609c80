"""What goes to a generator, and what comes of its answer."""

from array import array
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from probscene.app.loading import load_model, renderer_for
from probscene.derive import derive_complete
from probscene.errors import ModelError
from probscene.model import scene_model
from probscene.renderers.generator.renderer import GeneratedRenderer
from probscene.request import Objects
from probscene.sampling import run_program, sample, seed_everything
from probscene.scenarios import join
from probscene.worker import scene_of


def painted(scene, **more):
    """A picture whose pixels, in rows, belong to the nodes one after the other."""
    ids = np.zeros(scene.height * scene.width, np.int64)
    for node in scene.nodes:
        ids[10 * (node.id - 1) : 10 * node.id] = node.id
    colours = np.random.default_rng(scene.seed).integers(0, 256, (scene.height, scene.width, 3), np.uint8)
    return {"image": colours, "instance": ids.reshape(scene.height, scene.width), **more}


def batch_of(model, generator, request):
    return GeneratedRenderer(generator, model.canvas)(request)


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=30)
def test_a_scene_holds_what_was_sampled(model, seed):
    seed_everything(seed)
    scenes = sample(model, model.prior, 3)
    for i, record in enumerate(scenes.drawing.records((32, 40))):
        scene = scene_of(record)
        derived = scenes.derivation[i : i + 1].trimmed()
        assert [node.kind for node in scene.nodes] == [model.grammar.kinds[k] for k in derived.kind[0] if k >= 0]
        parents = [-1 if node.parent is None else node.parent.id - 1 for node in scene.nodes]
        assert parents == derived.parent[0][: len(parents)].tolist()
        for m, node in enumerate(scene.nodes):
            assert node.id == m + 1 and node.values == {k: float(scenes.parameters[k][i, m]) for k in "xy"}
        assert scene.values == {"light": float(scenes.parameters["light"][i, 0])}
        assert 0 <= scene.seed < 1 << 31 and (scene.height, scene.width) == (32, 40)


def test_the_seed_is_a_site_that_keeps_its_prior(model, request_of):
    assert len(set(request_of(50).seed.tolist())) == 50
    seed_everything(1)
    scenes = sample(model, model.prior, 4)
    again = run_program(model, scenes.derivation, scenes.parameters)
    assert torch.equal(again.drawing.seed, scenes.drawing.seed)
    trace = pyro.poutine.trace(model).get_trace(2)
    assert trace.nodes["request.seed"]["infer"] == {"learn": False}


def test_labels_are_counted_from_the_ids(model, request_of):
    request = request_of(8)
    batch = batch_of(model, painted, request)
    for i in range(8):
        for m in range(request.kind.shape[1]):
            rows, columns = (batch.instance[i] == m + 1).nonzero(as_tuple=True)
            assert batch.pixels[i, m] == len(rows) == (10 if request.kind[i, m] >= 0 else 0)
            assert batch.visible[i, m] == float(len(rows) > 0)
            if len(rows):
                box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
                assert batch.box[i, m].tolist() == box and torch.equal(batch.amodal_box[i, m], batch.box[i, m])
    assert batch.unknown == ("amodal_box", "visible") and batch.depth is None
    assert torch.equal(batch.kind, request.kind)


def test_amodal_boxes_and_depth_where_they_are_known(model, request_of):
    def deep(scene):
        boxes = {node.id: (-3.0, 0.5, 7.0, 9.0) for node in scene.nodes}
        return painted(scene, amodal_box=boxes, depth=np.full((32, 40), 7.5, np.float32))

    request = request_of(5)
    batch = batch_of(model, deep, request)
    assert batch.unknown == ("visible",) and batch.depth.shape == (5, 32, 40) and (batch.depth == 7.5).all()
    assert (batch.amodal_box[request.kind >= 0] == torch.tensor([-3.0, 0.5, 7.0, 9.0])).all()


def test_arrays_of_other_kinds_are_the_same(model, request_of):
    def plain(scene):
        drawn = painted(scene)
        ids = array("H", drawn["instance"].ravel().tolist())
        return {"image": drawn["image"].tobytes(), "instance": ids}

    def raw(scene):
        drawn = painted(scene)
        return {"image": drawn["image"][:, ::-1][:, ::-1], "instance": drawn["instance"].astype(np.uint16).tobytes()}

    request = request_of(4)
    expected = batch_of(model, painted, request)
    for generator in (plain, raw):
        found = batch_of(model, generator, request)
        assert torch.equal(found.image, expected.image) and torch.equal(found.instance, expected.instance)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: None, "return a dict with 'image' and 'instance', got NoneType"),
        (lambda d: {"image": d["image"]}, r"return a dict with 'image' and 'instance', got \['image'\]"),
        (lambda d: d | {"image": d["image"] / 255}, r"image as uint8 \(32, 40, 3\), got float64"),
        (lambda d: d | {"image": np.dstack([d["image"], d["image"][..., :1]])}, "leave its alpha out"),
        (lambda d: d | {"image": d["image"][:-1]}, r"got uint8 \(31, 40, 3\)"),
        (lambda d: d | {"image": "red"}, "'image' as an array of numpy's or as bytes, got str"),
        (lambda d: d | {"instance": d["instance"] + 0.5}, "instance as integers"),
        (lambda d: d | {"instance": d["instance"] + 99}, "instance, 0 to .*, got 99 to"),
        (lambda d: d | {"instance": d["instance"] - 1}, "got -1 to"),
        (lambda d: d | {"depth": np.full((32, 40), np.nan, np.float32)}, "depth without NaN"),
        (lambda d: d | {"amodal_box": {1: (5, 0, 4, 1)}}, "x0 <= x1"),
        (lambda d: d | {"amodal_box": {99: (0, 0, 4, 1)}}, "99"),
        (lambda d: d | {"amodal_box": {}}, "each node that instance shows.*got none of node"),
        (lambda d: d | {"amodal_box": dict.fromkeys(np.unique(d["instance"])[1:], (2, 2, 2, 5))}, "larger than 0"),
    ],
)
def test_what_is_no_picture_is_named(model, change, said):
    seed_everything(0)
    derivation, _ = derive_complete(model.grammar, model.prior, 20, model.max_steps)
    some = derivation[derivation.counts(2).sum(1) > 0][:1]
    request = run_program(model, some).drawing
    with pytest.raises(ModelError, match=said):
        batch_of(model, lambda scene: change(painted(scene)), request)


def test_an_id_of_a_node_that_is_none_is_named(model, request_of):
    """Nodes that only pad may lie between others, where scenarios are joined."""
    request = request_of(1)
    request = replace(
        request, kind=torch.tensor([[0, -1, 1]]), parent=torch.tensor([[-1, -1, 0]]), objects=(), scene=()
    )
    with pytest.raises(ModelError, match="got 2, which is of none"):
        batch_of(model, lambda scene: painted(scene) | {"instance": np.full((32, 40), 2)}, request)
    assert batch_of(model, painted, request).pixels.tolist() == [[10, 0, 10]]


def test_an_error_in_this_process_names_the_line(model, request_of):
    def broken(scene):
        return scene.values["fog"]

    with pytest.raises(ModelError, match=r"the generator to run, got KeyError in .*test_request.py, line \d+"):
        batch_of(model, broken, request_of(1))


def test_values_are_checked(model):
    def asked(**values):
        @scene_model(model.grammar, model.prior, canvas=(8, 8), max_steps=40, classes=("plate",), generator=painted)
        def probe(scene):
            return scene.request(Objects("plate", **values))

        return sample(probe, probe.prior, 4)

    with pytest.raises(ModelError, match=r"x of Objects\('plate'\) as a number or a tensor, got 'far'"):
        asked(x="far")
    with pytest.raises(ModelError, match="x of .* to broadcast"):
        asked(x=torch.zeros(3, 7))
    with pytest.raises(ModelError, match="finite numbers or lists of them, got NaN"):
        asked(x=float("nan"))
    record = asked(x=2, colour=torch.rand(4, 1, 3)).drawing.records((8, 8))[0]
    assert all(n["values"] == {} for n in record["nodes"] if n["kind"] == "mug")
    plates = [n["values"] for n in record["nodes"] if n["kind"] == "plate"]
    assert all(values["x"] == 2 and len(values["colour"]) == 3 for values in plates)


def test_a_request_is_made_outside_the_plate_of_nodes(model):
    @scene_model(model.grammar, model.prior, canvas=(8, 8), max_steps=40, classes=("plate",), generator=painted)
    def inside(scene):
        with scene.nodes("plate"):
            return scene.request(Objects("plate"))

    with pytest.raises(ModelError, match="outside scene.nodes"):
        seed_everything(3)
        sample(inside, inside.prior, 40)


def test_a_model_with_a_generator_returns_a_request(model):
    with pytest.raises(ModelError, match="generator of model 'boxes' as a function .* or a Command, got str"):
        replace(model, generator="python draw.py")
    other = load_model("multi_mnist")
    with pytest.raises(ModelError, match=r"return scene.request\(...\), got Drawing"):
        GeneratedRenderer(painted, (32, 40))(sample(other, other.prior, 1).drawing)


def test_a_request_needs_a_generator(model):
    with pytest.raises(ModelError, match="expected a generator of a model whose program returns scene.request"):
        renderer_for(replace(model, generator=None))(sample(model, model.prior, 1).drawing)


def test_photos_are_made_of_what_comes_back(model, request_of):
    request = request_of(3)
    seed_everything(0)

    @scene_model(model.grammar, model.prior, canvas=(32, 40), max_steps=40, classes=("plate",), generator=painted)
    def dark(scene):
        return scene.request(photo=scene.photo(exposure=0.25))

    plain = batch_of(model, painted, request)
    photo = sample(dark, dark.prior, 3).drawing.photo
    found = batch_of(model, painted, replace(request, photo=photo))
    assert found.image.float().mean() < 0.7 * plain.image.float().mean()


def test_scenarios_of_one_generator_are_joined(model):
    @scene_model(model.grammar, model.prior, canvas=(32, 40), max_steps=40, classes=("plate", "mug"), generator=painted)
    def day(scene):
        with scene.nodes("plate"):
            x = pyro.sample("x", dist.Uniform(0.0, 1.0))
        return scene.request(Objects("plate", x=x), scene={"day": 1.0})

    @scene_model(model.grammar, model.prior, canvas=(32, 40), max_steps=40, classes=("plate", "mug"), generator=painted)
    def night(scene):
        with scene.nodes("plate"):
            y = pyro.sample("y", dist.Uniform(0.0, 1.0))
        return scene.request(Objects("plate", y=y), scene={"lamps": 3.0})

    both = join("both", {"day": day, "night": night})
    seed_everything(0)
    scenes = sample(both, both.prior, 40)
    records, seen = scenes.drawing.records((32, 40)), set()
    for i, record in enumerate(records):
        (name,) = record["values"]
        seen.add(name)
        plates = [node for node in record["nodes"] if node["kind"] == "plate"]
        assert all(set(node["values"]) == {"x" if name == "day" else "y"} for node in plates)
        assert len(record["nodes"]) == int((scenes.derivation.kind[i] >= 0).sum())
    assert seen == {"day", "lamps"}
    with pytest.raises(ModelError, match="scenarios of one generator"):
        join("both", {"day": day, "night": replace(night, generator=print)})
