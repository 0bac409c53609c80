"""The decorator: what it makes is the model, and the Pyro program, that the long form makes."""

import copy
import inspect
import math
import pickle
import sys
from dataclasses import replace
from types import ModuleType

import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import poutine
from pyro.infer import SVI, Trace_ELBO
from pyro.optim import Adam

from probscene.derive import derive
from probscene.drawing import Sprites
from probscene.errors import ModelError
from probscene.grammar import Grammar
from probscene.model import SceneModel, scene_model
from probscene.sampling import sample, seed_everything
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts

GRAMMAR = Grammar("""
    Scene  -> table(Plates)
    Plates -> Plate Plates | ε
    Plate  -> plate(Mugs)
    Mugs   -> mug Mugs | ε
""")
PRIOR = StructurePrior(GRAMMAR, Plates=counts(1, 2, 1), Mugs=counts(2, 1, 1))
ABOUT = {"canvas": (64, 64), "max_steps": 30, "classes": ("plate", "mug")}


@scene_model(GRAMMAR, PRIOR, **ABOUT)
def tabletop(scene):
    with scene.nodes("plate"):
        x = pyro.sample("plate.x", dist.Uniform(10.0, 54.0))  # (N, M) pixels
    with scene.nodes("mug"):
        dx = pyro.sample("mug.dx", dist.Normal(0.0, 2.0))
    mug = Sprites.disc("mug", scene.of_parent(x) + dx, 32.0, radius=2.0)
    return scene.draw(Sprites.disc("plate", x, 32.0, radius=8.0), mug)


def long_form(num_scenes, structure=PRIOR):
    """The same with a plate, ``derive`` and ``SceneGraph`` of one's own."""
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, max_steps=30))
        with scene.nodes("plate"):
            x = pyro.sample("plate.x", dist.Uniform(10.0, 54.0))
        with scene.nodes("mug"):
            dx = pyro.sample("mug.dx", dist.Normal(0.0, 2.0))
    mug = Sprites.disc("mug", scene.of_parent(x) + dx, 32.0, radius=2.0)
    return scene.draw(Sprites.disc("plate", x, 32.0, radius=8.0), mug)


LONG = SceneModel("tabletop", GRAMMAR, PRIOR, long_form, (64, 64), 30, ("plate", "mug"))


def values(trace):
    return {name: site["value"] for name, site in trace.nodes.items() if site["type"] == "sample" and name != "scenes"}


def test_it_is_the_model_that_the_long_form_makes():
    for name in SceneModel.__dataclass_fields__:
        if name != "program":
            assert getattr(tabletop, name) == getattr(LONG, name), name
    named = scene_model(grammar=GRAMMAR, prior=PRIOR, name="lunch", channels=1, **ABOUT)(lambda scene: scene.draw())
    assert (named.name, named.channels) == ("lunch", 1)


@given(st.integers(0, 2**31), st.integers(1, 6))
def test_it_is_the_program_that_the_long_form_is(seed, num_scenes):
    traces, scenes = [], []
    for model in (tabletop, LONG):
        seed_everything(seed)
        traces.append(values(poutine.trace(model).get_trace(num_scenes, PRIOR)))
        scenes.append(sample(model, PRIOR, num_scenes))
    one, other = traces
    assert list(one) == list(other) and "rule_0" in one
    assert all(torch.equal(one[name], other[name]) for name in one if name != "_RETURN" and name != "_INPUT")
    one, other = scenes
    assert torch.equal(one.derivation.rules, other.derivation.rules) and torch.equal(one.log_prob, other.log_prob)
    assert all(torch.equal(one.parameters[name], value) for name, value in other.parameters.items())


def test_handlers_and_inference_take_it():
    seed_everything(1)
    trace = poutine.trace(tabletop).get_trace(5)
    again = poutine.trace(poutine.replay(tabletop, trace=trace)).get_trace(5)
    assert all(torch.equal(value, values(again)[name]) for name, value in values(trace).items())
    given_x = torch.full(trace.nodes["plate.x"]["value"].shape, 20.0)
    conditioned = poutine.condition(poutine.replay(tabletop, trace=trace), {"plate.x": given_x})
    drawing = conditioned(5)
    assert (drawing.layers[0].x == 20).all()

    def guide(num_scenes):
        """Every scene has a table alone; where plates would stand does not matter then."""
        with pyro.plate("scenes", num_scenes, dim=-2):
            derive(GRAMMAR, StructurePrior(GRAMMAR, Plates=counts(1)), num_scenes, 30)
            centre = pyro.param("centre", torch.tensor(32.0))
            with pyro.plate("nodes", 1, dim=-1):
                pyro.sample("plate.x", dist.Uniform(centre - 1, centre + 1))
                pyro.sample("mug.dx", dist.Normal(0.0, 2.0))

    pyro.clear_param_store()
    svi = SVI(tabletop, guide, Adam({"lr": 1e-2}), loss=Trace_ELBO())
    assert math.isfinite(svi.step(4))


def test_grammar_and_max_steps_are_said_once():
    """What ``dataclasses.replace`` changes in the model changes in its program."""
    short = replace(tabletop, max_steps=3)
    sites = [name for name in poutine.trace(short).get_trace(50).nodes if name.startswith("rule_")]
    assert len(sites) == 3
    full = StructurePrior(GRAMMAR, Plates=counts(0, 0, 0, 0, 0, 0, 1), Mugs=counts(0, 0, 1))
    longer = sample(replace(tabletop, prior=full, max_steps=60), full, 3)
    assert (longer.derivation.counts(3)[:, 2] == 12).all()
    assert tabletop.program.max_steps == 30
    other = Grammar("Scene -> table(Plates)\nPlates -> plate(Mugs) Plates | ε\nMugs -> mug Mugs | ε")
    model = replace(tabletop, grammar=other, prior=StructurePrior(other))
    assert (sample(model, model.prior, 5).drawing.kind[:, 0] == 0).all()


def test_it_is_pickled_by_its_name_and_copied(monkeypatch):
    """Worker processes find the function where its module has the model."""
    module = ModuleType("own_models")
    module.tabletop = tabletop
    monkeypatch.setitem(sys.modules, "own_models", module)
    monkeypatch.setattr(tabletop.program.draw, "__module__", "own_models")
    program = replace(tabletop, max_steps=17).program
    again = pickle.loads(pickle.dumps(program))
    assert again.draw is tabletop.program.draw and again.max_steps == 17 and again.grammar.rules == GRAMMAR.rules
    assert copy.deepcopy(tabletop).program.draw is tabletop.program.draw
    assert inspect.getdoc(tabletop.program) == inspect.getdoc(tabletop.program.draw)


def two(scene, structure):
    pass


class Table:
    def __init__(self, scene):
        pass


@pytest.mark.parametrize(
    ("what", "named"),
    [
        (two, r"got two\(scene, structure\)"),
        (lambda: None, r"got <lambda>\(\)"),
        (Table, "got Table"),
        (5, "got int"),
        (None, "got NoneType"),
        (tabletop, "got SceneModel"),
    ],
)
def test_what_is_no_function_of_a_scene_graph(what, named):
    with pytest.raises(ModelError, match=f"function of one argument, the SceneGraph, {named}; for a program"):
        scene_model(GRAMMAR, PRIOR, **ABOUT)(what)


OTHER = Grammar("Scene -> plate | mug")


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"grammar": "Scene -> plate"}, "got str for a grammar"),
        ({"prior": None}, "policy of the same grammar, .* got NoneType"),
        ({"prior": StructurePrior(OTHER)}, "got StructurePrior of another grammar"),
        ({"clases": ("plate",)}, "fields of a SceneModel in scene_model.*, got clases"),
        ({"program": long_form}, "got program"),
        ({"classes": ("cup",)}, r"'tabletop' among the grammar's objects .*got \['cup'\]"),
        ({"canvas": 64}, "positive canvas"),
        ({"max_steps": 0}, "max_steps 0"),
        ({"renderer": 3}, "renderer of model 'tabletop' as a class or function .* got int"),
        ({"assets_variable": "TABLES"}, "with_assets in model 'tabletop', whose assets TABLES names"),
    ],
)
def test_what_is_no_scene_model(given_, message):
    with pytest.raises(ModelError, match=message):
        scene_model(**{"grammar": GRAMMAR, "prior": PRIOR, **ABOUT, **given_})(tabletop.program.draw)


def test_one_class_needs_no_tuple():
    assert scene_model(GRAMMAR, PRIOR, **{**ABOUT, "classes": "mug"})(tabletop.program.draw).classes == ("mug",)
