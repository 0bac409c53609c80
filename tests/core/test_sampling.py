"""log q(T, alpha) of a small program, against scipy."""

import importlib
import random
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from probscene.derivation import Derivation, expand
from probscene.derive import derive, derive_complete
from probscene.drawing import Sprites
from probscene.errors import ModelError, SamplingError
from probscene.grammar import Grammar
from probscene.model import SceneModel
from probscene.sampling import log_prob, run_program, sample, seed_everything
from probscene.scenarios import join
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("""
    Scene  -> table(Plates)
    Plates -> Plate Plates | ε
    Plate  -> plate(Mugs)
    Mugs   -> mug Mugs | spoon | ε
""")
PRIOR = StructurePrior(GRAMMAR, Plates=counts(1, 2, 1), Mugs=weights(2, 1, 3))
STEPS = 40


def tabletop(num_scenes, structure):
    with pyro.plate("scenes", num_scenes, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, STEPS))
        light = pyro.sample("light", dist.Gamma(2.0, 3.0))  # (N, 1)
        with scene.nodes("plate"):
            x = pyro.sample("plate.x", dist.Uniform(10.0, 90.0))
            tint = pyro.sample("plate.tint", dist.Beta(torch.tensor([1.0, 2.0, 3.0]), 2.0).to_event(1))
        with scene.nodes("mug", "spoon"):
            dx = pyro.sample("mug.dx", dist.Normal(scene.of_parent(x) / 10, light))
    mug = Sprites.disc(("mug", "spoon"), scene.of_parent(x) + dx, 50.0, radius=3.0)
    return scene.draw(Sprites.disc("plate", x, 50.0, radius=9.0, tint=tint), mug)


MODEL = SceneModel("tabletop", GRAMMAR, PRIOR, tabletop, (100, 100), STEPS, ("plate", "mug"))


def alpha_log_prob(scenes, i):
    """log q(alpha | T) of one scene by scipy, node by node."""
    kind, parent = scenes.derivation.kind[i].tolist(), scenes.derivation.parent[i].tolist()
    value = {name: v[i].double().numpy() for name, v in scenes.parameters.items()}
    light = value["light"][0]
    total = stats.gamma(2.0, scale=1 / 3).logpdf(light)
    for m, k in enumerate(kind):
        if k == GRAMMAR.kind("plate"):
            total += stats.uniform(10, 80).logpdf(value["plate.x"][m])
            total += sum(stats.beta(a, 2.0).logpdf(t) for a, t in zip((1, 2, 3), value["plate.tint"][m], strict=True))
        if k in (GRAMMAR.kind("mug"), GRAMMAR.kind("spoon")):
            total += stats.norm(value["plate.x"][parent[m]] / 10, light).logpdf(value["mug.dx"][m])
    return total


@given(st.integers(0, 2**31), st.integers(1, 9))
def test_log_prob_of_structure_and_parameters(reference, seed, num_scenes):
    seed_everything(seed)
    scenes = sample(MODEL, PRIOR, num_scenes)
    joint = log_prob(PRIOR, scenes)
    assert joint.shape == (num_scenes,) and set(scenes.parameters) == {"light", "plate.x", "plate.tint", "mug.dx"}
    for i in range(num_scenes):
        alpha = alpha_log_prob(scenes, i)
        assert scenes.log_prob[i].item() == pytest.approx(alpha, rel=1e-3, abs=1e-3)
        rules = [k for k in scenes.derivation.rules[i].tolist() if k >= 0]
        structure = reference.log_probability(GRAMMAR, PRIOR, rules)
        assert joint[i].item() == pytest.approx(structure + alpha, rel=1e-3, abs=1e-3)


@given(st.integers(0, 2**31))
def test_the_same_parameters_make_the_same_scenes(seed):
    seed_everything(seed)
    scenes = sample(MODEL, PRIOR, 5)
    again = run_program(MODEL, scenes.derivation, scenes.parameters)
    assert torch.equal(again.log_prob, scenes.log_prob)
    for one, other in zip(scenes.drawing.layers, again.drawing.layers, strict=True):
        for name in ("present", "x", "y", "tint"):
            assert torch.equal(getattr(one, name), getattr(other, name))
    fresh = run_program(MODEL, scenes.derivation, {"plate.x": scenes.parameters["plate.x"]})
    assert torch.equal(fresh.drawing.layers[0].x, scenes.drawing.layers[0].x)
    assert not torch.equal(fresh.parameters["light"], scenes.parameters["light"])


@given(st.integers(0, 2**31))
def test_without_a_density_the_scenes_are_the_same(seed):
    seed_everything(seed)
    scenes = sample(MODEL, PRIOR, 5)
    seed_everything(seed)
    same = sample(MODEL, PRIOR, 5, density=False)
    assert same.log_prob.shape == (5,) and same.log_prob.isnan().all()
    for name, value in scenes.parameters.items():
        assert torch.equal(same.parameters[name], value) and torch.equal(same.site_mask[name], scenes.site_mask[name])


@given(st.integers(0, 2**32 - 1))
def test_a_seed_is_that_of_pyro(seed):
    def drawn():
        return torch.rand(2).tolist(), np.random.rand(2).tolist(), random.random()

    pyro.set_rng_seed(seed)
    expected = drawn()
    seed_everything(seed)
    assert drawn() == expected


def test_parameters_count_where_their_nodes_are():
    scenes = sample(MODEL, PRIOR, 30)
    kind = scenes.derivation.kind
    assert torch.equal(scenes.site_mask["plate.x"], kind == GRAMMAR.kind("plate"))
    assert torch.equal(scenes.site_mask["mug.dx"], (kind == GRAMMAR.kind("mug")) | (kind == GRAMMAR.kind("spoon")))
    assert scenes.site_mask["light"].shape == (30, 1) and scenes.site_mask["light"].all()
    assert torch.equal(scenes.drawing.kind, kind) and (scenes.failures == 0).all()


def test_parameters_follow_the_given_structure_not_the_prior():
    empty = StructurePrior(GRAMMAR, Plates=counts(1))
    full = StructurePrior(GRAMMAR, Plates=counts(0, 0, 0, 1))
    assert (sample(MODEL, empty, 20).derivation.counts(4)[:, 1] == 0).all()
    scenes = sample(MODEL, full, 20)  # three plates, which MODEL's own prior never has
    assert (scenes.derivation.counts(4)[:, 1] == 3).all() and torch.isfinite(scenes.log_prob).all()
    assert torch.isinf(log_prob(PRIOR, scenes)).all() and torch.isfinite(log_prob(full, scenes)).all()


def test_scenes_that_are_too_long_are_redrawn_or_refused():
    short = replace(MODEL, max_steps=6)
    scenes = sample(short, PRIOR, 200)
    assert scenes.derivation.lengths.max() <= 6 and scenes.failures.sum() > 0
    with pytest.raises(SamplingError, match="max_steps = 6"):
        sample(short, StructurePrior(GRAMMAR, Plates=counts(0, 0, 1)), 3)


def test_programs_that_are_none():
    def no_drawing(num_scenes, structure):
        tabletop(num_scenes, structure)

    def no_plate(num_scenes, structure):
        pyro.sample("loose", dist.Normal(0.0, 1.0))
        return tabletop(num_scenes, structure)

    with pytest.raises(ModelError, match="'tabletop' to return a Drawing or a World of 4 scenes .* got NoneType"):
        sample(replace(MODEL, program=no_drawing), PRIOR, 4)
    with pytest.raises(ModelError, match="'loose'.*inside the scenes plate"):
        sample(replace(MODEL, program=no_plate), PRIOR, 4)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"classes": ("plate", "cup")}, r"\['cup'\]"),
        ({"classes": ()}, "got none"),
        ({"stuff": ("cup",)}, r"stuff .* got \['cup'\]"),
        ({"stuff": ("plate", "mug")}, "and not all"),
        ({"canvas": (0, 5)}, "positive canvas"),
        ({"max_steps": 0}, "max_steps 0"),
        ({"channels": 4}, "channels 1 or 3"),
    ],
)
def test_models_that_are_none(changed, message):
    with pytest.raises(ModelError, match=message):
        replace(MODEL, **changed)


@pytest.fixture
def expanded(monkeypatch):
    """The numbers of scenes that the stack machine has run over."""
    ran = []

    def counting(grammar, choose, N, max_steps):
        ran.append(N)
        return expand(grammar, choose, N, max_steps)

    for module in ("derivation", "derive", "scenarios"):
        monkeypatch.setattr(importlib.import_module(f"probscene.{module}"), "expand", counting)
    return ran


def test_a_batch_is_expanded_once(expanded):
    ended = StructurePrior(GRAMMAR, Plates=counts(1, 2, 1), Mugs=weights(0, 1, 3))
    scenes = sample(MODEL, ended, 7)
    assert expanded == [7]
    run_program(MODEL, scenes.derivation)
    assert expanded == [7]
    joint = join("both", {"one": MODEL, "other": MODEL})
    sample(joint, joint.prior, 5)
    assert expanded[1] == 5 and set(expanded[2:]) <= {1}  # of one scene: each scenario's shortest derivation
    del expanded[:]
    sample(joint, joint.prior, 5)
    assert expanded == [5]


@given(st.integers(0, 2**31), st.integers(1, 9), st.integers(4, 30))
def test_complete_derivations_are_those_that_their_rules_spell(seed, num_scenes, max_steps):
    """Whatever was redrawn, and for any part of a batch."""
    seed_everything(seed)
    derivation, failures = derive_complete(GRAMMAR, PRIOR, num_scenes, max_steps)
    for some in (derivation, derivation[failures == 0].trimmed(), derivation[:1].trimmed()):
        spelt = Derivation.from_rules(GRAMMAR, some.rules)
        for name in ("rules", "complete", "kind", "parent"):
            assert torch.equal(getattr(some, name), getattr(spelt, name))
        assert all(map(torch.equal, some.frontier, spelt.frontier))


def test_a_program_with_a_smaller_max_steps_is_refused():
    def short(num_scenes, structure):
        with pyro.plate("scenes", num_scenes, dim=-2):
            return SceneGraph(GRAMMAR, derive(GRAMMAR, structure, num_scenes, max_steps=9)).draw()

    model = replace(MODEL, program=short)
    full = StructurePrior(GRAMMAR, Plates=counts(0, 0, 0, 1), Mugs=weights(0, 0, 1))
    with pytest.raises(ModelError, match=r"max_steps of at least 1\d, .* got max_steps = 9: .*fewer objects"):
        sample(model, full, 4)
    assert len(sample(model, StructurePrior(GRAMMAR, Plates=counts(1)), 4).drawing) == 4


@pytest.mark.parametrize("of", ["another derivation", "another grammar"])
def test_a_program_that_draws_other_nodes_is_refused(of):
    other = Grammar("Scene -> table(Plates)\nPlates -> plate Plates | ε")
    grammar = GRAMMAR if of == "another derivation" else other

    def loose(num_scenes, structure):
        derivation, _ = derive_complete(grammar, StructurePrior(grammar, Plates=counts(1)), num_scenes, STEPS)
        return SceneGraph(grammar, derivation).draw()

    plates = StructurePrior(GRAMMAR, Plates=counts(0, 1), Mugs=weights(0, 0, 1))
    with pytest.raises(
        ModelError, match="'tabletop' to draw .* scene 0: derived table, plate; drawn table. Derive with"
    ):
        sample(replace(MODEL, program=loose), plates, 4)


def test_derivations_that_are_not_complete_are_refused():
    with torch.no_grad(), pyro.plate("scenes", 3, dim=-2):
        cut = derive(GRAMMAR, StructurePrior(GRAMMAR, Plates=counts(0, 0, 1)), 3, max_steps=2)
    with pytest.raises(ModelError, match="expected complete derivations for model 'tabletop', got 3 of 3"):
        run_program(MODEL, cut)
