"""Several models as one: every law against the scenarios' own models."""

import math
from collections import Counter
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import poutine
from scipy.stats import binom

from probscene.derive import derive, derive_complete
from probscene.drawing import Sprites
from probscene.enumeration import enumerate_derivations
from probscene.errors import ModelError
from probscene.grammar import Grammar
from probscene.inference.guides.scenario import ScenarioGuide
from probscene.model import Groups, SceneModel
from probscene.policy import Policy
from probscene.sampling import log_prob, run_program, sample
from probscene.scenarios import JointGrammar, Mixture, join
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, ranked, weights

DISCS = Grammar("Scene -> Discs\nDiscs -> disc Discs | ε")
BOXES = Grammar("Scene -> plate Boxes | plate\nBoxes -> box(Lids) Boxes | ε\nLids -> disc | ε")
PRIORS = {
    "discs": StructurePrior(DISCS, Discs=counts(1, 1, 1)),
    "boxes": StructurePrior(
        BOXES, Scene=weights(3, 1), Boxes=counts(1, 1, 1), Lids=ranked(weights(1, 3), weights(1, 1))
    ),
}
JOINT = JointGrammar({"discs": DISCS, "boxes": BOXES})


def model_of(name, grammar, kinds, **more):
    """A model whose objects stand anywhere, every kind at a site of its own."""

    def program(num_scenes, structure):
        with pyro.plate("scenes", num_scenes, dim=-2):
            scene = SceneGraph(grammar, derive(grammar, structure, num_scenes, 12))
            x = {}
            for kind in kinds:
                with scene.nodes(kind):
                    x[kind] = pyro.sample(f"{kind}.x", dist.Uniform(0.0, 64.0))
        stars = Sprites.disc((), torch.full((1, 2), 5.0), 5.0, 2.0)
        stars = replace(stars, present=torch.ones(num_scenes, 2, dtype=torch.bool))
        return scene.draw(stars, *(Sprites.disc(kind, x[kind], 30.0, 4.0) for kind in kinds))

    given = {"classes": kinds, **more}
    return SceneModel(name, grammar, PRIORS[name], program, (64, 64), 12, **given)


MODELS = {
    "discs": model_of("discs", DISCS, ("disc",)),
    "boxes": model_of("boxes", BOXES, ("box", "disc", "plate"), classes=("box", "disc")),
}
MODEL = join("both", MODELS, [1.0, 3.0])


@st.composite
def policies(draw):
    """The joint table, a mixture of the tables, or guides with random weights, each with the parts' own policies."""
    share = draw(st.sampled_from([None, [1.0, 3.0]]))
    kind = draw(st.sampled_from(["table", "mixture", "lstm", "pcfg", "grammar-vae"]))
    if kind == "table":
        first = JOINT.first_symbol, JOINT.first_rule
        joint = StructurePrior.joined(JOINT, list(PRIORS.values()), *first, share or [1.0, 1.0])
        return joint, list(PRIORS.values()), share
    if kind == "mixture":
        return Mixture(JOINT, list(PRIORS.values()), share), list(PRIORS.values()), share
    torch.manual_seed(draw(st.integers(0, 2**31)))
    settings = {} if kind == "pcfg" else {"hidden": 4, "num_latents": draw(st.sampled_from([1, 3]))}
    guide = ScenarioGuide(JOINT, 9, share, kind, **settings)
    for parameter in guide.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    return guide, list(guide.guides), share


def test_the_joint_grammar_spells_every_parts_derivations_and_no_others():
    spelt = Counter()
    for derivation in (enumerate_derivations(JOINT, 7),):
        for number, name in enumerate(("discs", "boxes")):
            rows = (JOINT.scenario(derivation) == number).nonzero().flatten()
            own = JOINT.own(derivation[rows], number)
            own_grammar = (DISCS, BOXES)[number]
            again = enumerate_derivations(own_grammar, 6)
            assert sorted(map(str, rules_of(own.rules))) == sorted(map(str, rules_of(again.rules)))
            again = type(own).from_rules(own_grammar, own.rules)
            M = again.kind.shape[1]
            assert torch.equal(again.kind, own.kind[:, :M]) and torch.equal(again.parent, own.parent[:, :M])
            for mine, theirs in zip(own.frontier, again.frontier, strict=True):
                assert torch.equal(mine[:, : theirs.shape[1]], theirs)
            assert again.complete.all()
            spelt[name] += len(rows)
    assert spelt["discs"] == 5 and JOINT.kinds == ("disc", "plate", "box")


def rules_of(rules):
    return [[k for k in row if k >= 0] for row in rules.tolist()]


@given(policies())
def test_log_prob_is_the_scenarios_weight_and_its_own_policys(drawn):
    policy, parts, share = drawn
    derivation = enumerate_derivations(JOINT, 7)
    found = policy.log_prob(derivation)
    for i, number in enumerate(JOINT.scenario(derivation).tolist()):
        own = type(derivation).from_rules((DISCS, BOXES)[number], JOINT.own(derivation[i : i + 1], number).rules)
        weight = math.log((share or [1.0, 1.0])[number] / sum(share or [1.0, 1.0]))
        assert found[i].item() == pytest.approx(weight + parts[number].log_prob(own).item(), abs=1e-4)


@given(policies(), st.integers(0, 2**31))
def test_samples_follow_log_prob(drawn, seed):
    policy, _, _ = drawn
    every = enumerate_derivations(JOINT, 9)
    q = policy.log_prob(every).detach().double().exp()
    pyro.set_rng_seed(seed)
    with torch.no_grad(), pyro.plate("scenes", 4000, dim=-2):
        sampled = derive(JOINT, policy, 4000, 9)
    rules = torch.nn.functional.pad(sampled.rules, (0, every.rules.shape[1] - sampled.rules.shape[1]), value=-1)
    found = (rules[sampled.complete].unsqueeze(1) == every.rules).all(-1)
    assert (found.sum(1) == 1).all()
    low, high = binom.interval(1 - 1e-10, 4000, q.clamp(max=1))
    number = found.sum(0).numpy()
    assert ((low <= number) & (number <= high)).all()


@given(policies().filter(lambda drawn: not isinstance(drawn[0], StructurePrior)))
def test_one_step_after_the_other_gives_the_same(drawn):
    policy, parts, _ = drawn
    if any(len(getattr(part, "latents", [0])) > 1 for part in parts):
        return
    derivation = enumerate_derivations(JOINT, 6)
    torch.testing.assert_close(Policy.log_prob(policy, derivation), policy.log_prob(derivation), rtol=1e-4, atol=1e-5)


def test_a_guide_learns_each_scenario_from_its_own_scenes():
    guide = ScenarioGuide(JOINT, 9, hidden=4)
    derivation = enumerate_derivations(JOINT, 7)
    discs = (guide.strata(derivation) == 0).nonzero().flatten()
    guide.log_prob(derivation[discs]).sum().backward()
    graded = [any(p.grad is not None and p.grad.abs().sum() > 0 for p in part.parameters()) for part in guide.guides]
    assert graded == [True, False]


def test_scenes_of_the_joint_model_are_those_of_the_scenarios():
    """The same parameters in a scenario's own model draw the same, and have the same log-probability."""
    pyro.set_rng_seed(2)
    scenes = sample(MODEL, MODEL.prior, 40)
    scenario = MODEL.grammar.scenario(scenes.derivation)
    total = torch.zeros(40)
    assert set(scenario.tolist()) == {0, 1}
    for number, (name, model) in enumerate(MODELS.items()):
        rows = (scenario == number).nonzero().flatten()
        own = type(scenes.derivation).from_rules(
            model.grammar, MODEL.grammar.own(scenes.derivation[rows], number).rules
        )
        M = own.kind.shape[1]
        sites = [site for site in scenes.parameters if site.startswith(f"{name}/")]
        assert len(sites) == len(model.grammar.kinds)
        values = {site.split("/")[1]: scenes.parameters[site][rows][:, :M] for site in sites}
        alone = run_program(model, own, values)
        total[rows] = alone.log_prob
        for site in sites:
            counted = scenes.site_mask[site][rows]
            assert torch.equal(counted[:, :M], alone.site_mask[site.split("/")[1]]) and not counted[:, M:].any()
        drawn = {}
        for drawing, which, names in (
            (scenes.drawing, rows, MODEL.grammar.kinds),
            (alone.drawing, slice(None), model.grammar.kinds),
        ):
            drawn[names] = [
                sorted(
                    (names[kind] if layer.labelled else "", round(x, 4))
                    for layer in drawing.layers
                    for x, kind in zip(
                        layer.x[which][i][layer.present[which][i]].tolist(),
                        (drawing.kind if layer.labelled else layer.sprite)[which][i][: layer.x.shape[1]][
                            layer.present[which][i]
                        ].tolist(),
                        strict=True,
                    )
                )
                for i in range(len(rows))
            ]
        assert len(set(map(str, drawn.values()))) == 1
    assert torch.allclose(log_prob(MODEL.prior, scenes) - MODEL.prior.log_prob(scenes.derivation), total, atol=1e-4)


def test_the_joint_model_has_what_its_scenarios_have():
    assert MODEL.classes == ("disc", "box") and MODEL.max_steps == 13 and MODEL.groups is None
    assert dict(MODEL.scenarios) == MODELS
    assert isinstance(MODEL.prior, StructurePrior)
    derivation, _ = derive_complete(MODEL.grammar, MODEL.prior, 4000, 13)
    assert MODEL.grammar.scenario(derivation).float().mean().item() == pytest.approx(0.75, abs=0.04)
    grouped = {
        name: replace(model, classes=("disc", "box"), groups=Groups("box"))
        for name, model in MODELS.items()
        if name == "boxes"
    }
    assert join("one", grouped).groups == Groups("box")
    soft = {name: replace(model, stuff=("box",)) if "box" in model.classes else model for name, model in MODELS.items()}
    assert MODEL.stuff == () and join("soft", soft).stuff == ("box",)


def test_a_scenario_can_be_no_table():
    class Fair(Policy):
        grammar = DISCS

        def step(self, memory, frontier, previous_rule):
            return torch.zeros(len(frontier.symbol), len(DISCS.rules)), memory

    mixed = join("mixed", {**MODELS, "discs": replace(MODELS["discs"], prior=Fair())})
    assert isinstance(mixed.prior, Mixture)
    pyro.set_rng_seed(0)
    scenes = sample(mixed, mixed.prior, 200)
    assert scenes.derivation.complete.all()


def test_targets_are_joined():
    def target(seed):
        return replace(MODELS["discs"], name="discs_target", prior=StructurePrior(DISCS, Discs=counts(0, 0, 0, 1)))

    joint = join("both", {name: replace(model, target=target) for name, model in MODELS.items() if name == "discs"})
    truth = joint.target(3)
    scenes = sample(truth, truth.prior, 10)
    assert (scenes.derivation.counts(1)[:, 0] == 3).all()
    assert MODEL.target is None


def test_scenes_may_be_longer_than_a_scenarios_own_max_steps():
    """As the joint guide's may be; none of their objects is lost."""
    short = replace(MODELS["discs"], max_steps=4)
    joint = join("both", {"discs": short, "boxes": MODELS["boxes"]})
    rows = torch.tensor([[0, *[2 + k for k in (0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 2)]]])
    derivation = type(enumerate_derivations(JOINT, 4)).from_rules(joint.grammar, rows)
    scenes = run_program(joint, derivation)
    assert derivation.complete.all() and int(scenes.drawing.layers[1].present.sum()) == 9


def test_a_scenario_that_draws_other_nodes_is_refused():
    def empty(num_scenes, structure):
        derivation, _ = derive_complete(DISCS, StructurePrior(DISCS, Discs=counts(1)), num_scenes, 12)
        return SceneGraph(DISCS, derivation).draw()

    full = replace(MODELS["discs"], program=empty, prior=StructurePrior(DISCS, Discs=counts(0, 0, 1)))
    joint = join("both", {"discs": full, "boxes": MODELS["boxes"]})
    with pytest.raises(ModelError, match="program of model 'discs' to draw .* derived disc, disc; drawn none"):
        sample(joint, joint.prior, 20)


def test_scenarios_that_do_not_go_together():
    with pytest.raises(ModelError, match="at least one scenario"):
        join("none", {})
    with pytest.raises(ModelError, match="one canvas, got"):
        join("two", {**MODELS, "discs": replace(MODELS["discs"], canvas=(32, 64))})


def test_a_trace_of_the_joint_program_names_no_rule_twice():
    pyro.set_rng_seed(0)
    trace = poutine.trace(MODEL).get_trace(30)
    rules = [name for name in trace.nodes if "rule_" in name]
    assert rules == [f"rule_{t}" for t in range(len(rules))]
