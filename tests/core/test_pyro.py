"""What a Pyro user does with a program that derives: traces, inference, inspection, saving."""

import copy
import io
import pickle
from functools import partial

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import MCMC, NUTS, SVI, Importance, Predictive, Trace_ELBO, TraceEnum_ELBO, config_enumerate
from pyro.infer.autoguide import AutoNormal
from pyro.infer.inspect import get_model_relations

from probscene.derivation import Derivation
from probscene.derive import derive
from probscene.enumeration import enumerate_derivations
from probscene.errors import ModelError
from probscene.grammar import Grammar
from probscene.inference.guides.lstm import make_guide
from probscene.inference.guides.scenario import ScenarioGuide
from probscene.inference.objective import ScoreFunction
from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.meta_sim.transform import ParameterTransform
from probscene.inference.parameters.sites import find_sites
from probscene.models.multi_mnist import MODEL
from probscene.policy import Policy
from probscene.scenarios import JointGrammar, join
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, weights

GRAMMAR = Grammar("Table -> cloth Plates\nPlates -> plate Plates | ε")
PRIOR = StructurePrior(GRAMMAR, Plates=counts(1, 1, 1, 1))
OTHER = StructurePrior(Grammar("Sky -> sun | moon"))
MAX_STEPS, N, MAX_NODES = 6, 4, 5
TRUE = 1.5
GIVEN = Derivation.from_rules(GRAMMAR, torch.tensor([[0, 1, 1, 2]] * N))


def structure(num_scenes=N, static=False):
    with pyro.plate("scenes", num_scenes, dim=-2):
        return derive(GRAMMAR, PRIOR, num_scenes, MAX_STEPS, static=static)


def measured(data=None, static=False, max_nodes=None):
    """Plates stand to the right of a place that all scenes share; ``data (N, M)`` are where."""
    left = pyro.sample("left", dist.Normal(0.0, 2.0))
    with pyro.plate("scenes", N, dim=-2):
        scene = SceneGraph(GRAMMAR, derive(GRAMMAR, PRIOR, N, MAX_STEPS, static=static), max_nodes)
        with scene.nodes("plate"):
            x = pyro.sample("plate.x", dist.Uniform(0.0, 1.0))
            pyro.sample("read", dist.Normal(left + x, 0.1), obs=data)
    return scene.kind


def given_structure(program):
    return poutine.condition(program, data=GIVEN.sites())


def test_predictive_draws_one_program_many_times():
    torch.manual_seed(0)
    found = Predictive(structure, num_samples=600)(1, static=True)
    assert sorted(found) == [f"rule_{t}" for t in range(MAX_STEPS)]
    assert found["rule_0"].shape == (600, 1, 1)
    rules = torch.stack([found[f"rule_{t}"][:, 0, 0] for t in range(MAX_STEPS)], 1)
    number = ((rules == 1).cumprod(1) if rules[0, 0] == 1 else (rules[:, 1:] == 1).long().cumprod(1)).sum(1)
    share = number.bincount(minlength=4) / 600
    assert (share - 0.25).abs().max() < 0.08


def drawn_often(model, *args):
    found = Predictive(model, num_samples=40)(*args)
    assert all(len(values) == 40 for values in found.values())
    return {name: tuple(values.shape[1:]) for name, values in found.items()}


def test_predictive_needs_no_static():
    """Of what derives, of a guide, of parameters on nodes; of a scene model, and of one of several scenarios."""
    pyro.clear_param_store()
    torch.manual_seed(0)
    rules = {f"rule_{t}": (N, 1) for t in range(MAX_STEPS)}
    assert drawn_often(structure) == rules
    assert drawn_often(make_guide("lstm", GRAMMAR, MAX_STEPS), N) == rules
    assert drawn_often(measured) == rules | {"left": (1, 1), "plate.x": (N, MAX_STEPS), "read": (N, MAX_STEPS)}
    assert drawn_often(measured, None, True, MAX_NODES)["plate.x"] == (N, MAX_NODES)
    found = drawn_often(MODEL, 2)
    assert sum(name.startswith("rule_") for name in found) == MODEL.max_steps
    two = join("two", {"one": MODEL, "other": MODEL})
    assert {f"{scenario}/digit.x" for scenario in ("one", "other")} <= set(drawn_often(two, 2))


def test_static_sites_after_the_end_count_nothing():
    torch.manual_seed(0)
    trace = poutine.trace(structure).get_trace(static=True)
    derivation = trace.nodes["_RETURN"]["value"]
    expected = PRIOR.log_prob(derivation).sum()
    assert torch.allclose(trace.log_prob_sum(), expected, atol=1e-5)
    assert sum(name.startswith("rule_") for name in trace.nodes) == MAX_STEPS


def test_importance_weighs_structures_by_what_was_counted():
    """Of four lengths that are equally probable, what is seen is as likely as a Poisson number says."""

    def program():
        number = (structure(1).kind == 1).sum()
        pyro.sample("seen", dist.Poisson(number + 0.5), obs=torch.tensor(3.0))
        return number

    torch.manual_seed(0)
    posterior = Importance(program, num_samples=500).run()
    weight = torch.stack([*map(torch.as_tensor, posterior.log_weights)]).exp()
    number = torch.tensor([int(trace.nodes["_RETURN"]["value"]) for trace in posterior.exec_traces])
    found = torch.zeros(4).index_add(0, number, weight) / weight.sum()
    exact = dist.Poisson(torch.arange(4) + 0.5).log_prob(torch.tensor(3.0)).softmax(0)
    assert (found - exact).abs().max() < 0.07


def test_nuts_learns_parameters_given_a_structure():
    torch.manual_seed(0)
    data = TRUE + torch.tensor([[0.0, 0.05, 0.95]] * N)
    kernel = NUTS(given_structure(measured), max_tree_depth=5)
    chain = MCMC(kernel, num_samples=40, warmup_steps=40, disable_progbar=True)
    chain.run(data)
    assert abs(float(chain.get_samples()["left"].mean()) - TRUE) < 0.3


def test_an_autoguide_sees_one_shape_whatever_is_derived():
    pyro.clear_param_store()
    torch.manual_seed(0)
    program = poutine.block(measured, hide_fn=lambda site: site["name"].startswith("rule_"))
    guide = AutoNormal(program)
    svi = SVI(program, guide, pyro.optim.Adam({"lr": 0.01}), Trace_ELBO())
    losses = [svi.step(None, True, MAX_NODES) for _ in range(4)]
    assert all(loss == loss for loss in losses)
    assert dict(guide.named_parameters())["locs.plate.x_unconstrained"].shape == (N, MAX_NODES)


def test_more_nodes_than_asked_for_are_named():
    with pytest.raises(ModelError, match="at most max_nodes = 2 nodes, got 3"):
        SceneGraph(GRAMMAR, GIVEN, 2)


def test_a_scene_is_the_same_in_a_wider_graph():
    scene, wide = SceneGraph(GRAMMAR, GIVEN), SceneGraph(GRAMMAR, GIVEN, MAX_NODES)
    assert wide.kind.shape == (N, MAX_NODES)
    assert torch.equal(wide.kind[:, :3], scene.kind) and (wide.kind[:, 3:] == -1).all()
    assert torch.equal(wide.rank("plate")[:, :3], scene.rank("plate"))


def particles():
    loss = Trace_ELBO(num_particles=3, vectorize_particles=True, max_plate_nesting=2)
    SVI(structure, lambda: None, pyro.optim.Adam({}), loss).evaluate_loss()


def enumerated():
    TraceEnum_ELBO(max_plate_nesting=2).loss(config_enumerate(structure), lambda: None)


def in_parallel():
    Predictive(structure, num_samples=3, parallel=True)()


def without_its_dim():
    with poutine.trace(), pyro.plate("scenes", N):
        derive(GRAMMAR, PRIOR, N, MAX_STEPS)


@pytest.mark.parametrize("num_scenes", [1, N])
@pytest.mark.parametrize("static", [False, True])
def test_sequential_enumeration_says_what_to_do(num_scenes, static):
    loss, enumerated = TraceEnum_ELBO(max_plate_nesting=2), config_enumerate(structure, "sequential")
    for model, guide in ((enumerated, lambda *_: None), (structure, enumerated)):
        with pytest.raises(ModelError, match="'rule_0' to be sampled, got sequential .*enumerate_derivations"):
            loss.loss(model, guide, num_scenes, static)


def test_other_sites_are_enumerated_beside_rules():
    def program():
        structure()
        side = pyro.sample("side", dist.Categorical(torch.tensor([0.3, 0.7])), infer={"enumerate": "parallel"})
        pyro.sample("seen", dist.Normal(side.float(), 1.0), obs=torch.tensor(0.2))

    found = TraceEnum_ELBO(max_plate_nesting=2).loss(program, lambda: structure())
    normal = dist.Normal(torch.tensor([0.0, 1.0]), 1.0).log_prob(torch.tensor(0.2))
    assert found == pytest.approx(-float((torch.tensor([0.3, 0.7]).log() + normal).logsumexp(0)))


@pytest.mark.parametrize("run", [particles, enumerated, in_parallel, without_its_dim])
def test_what_has_no_one_rule_a_scene_says_what_to_do(run):
    with pytest.raises(ModelError, match=r"one rule a scene, got .*dim=-2.*enumerate_derivations") as caught:
        run()
    assert caught.value.__cause__ is None


def test_a_sum_over_structures_is_exact():
    assert torch.allclose(PRIOR.log_prob(enumerate_derivations(GRAMMAR, MAX_STEPS)).exp().sum(), torch.tensor(1.0))


def test_a_rule_that_does_not_fit_is_named():
    wrong = poutine.condition(structure, data={"rule_1": torch.zeros(N, 1, dtype=torch.int64)})
    with pytest.raises(ModelError, match=r"'rule_1' a rule of Plates in scene 0, got 0 \(Table -> cloth Plates\)"):
        wrong()


def test_two_structures_in_one_program():
    def program():
        with pyro.plate("scenes", N, dim=-2):
            table = derive(GRAMMAR, PRIOR, N, MAX_STEPS)
            sky = derive(OTHER.grammar, OTHER, N, 1, name="sky")
            again = derive(GRAMMAR, PRIOR, N, MAX_STEPS, name="again")
        return table, sky, again

    torch.manual_seed(0)
    trace = poutine.trace(program).get_trace()
    table, sky, again = trace.nodes["_RETURN"]["value"]
    assert {"rule_0", "sky_0", "again_0"} <= set(trace.nodes)
    expected = PRIOR.log_prob(table) + OTHER.log_prob(sky) + PRIOR.log_prob(again)
    assert torch.allclose(trace.log_prob_sum(), expected.sum(), atol=1e-5)
    replayed = poutine.replay(program, trace)()
    assert all(torch.equal(one.rules, other.rules) for one, other in zip(replayed, (table, sky, again), strict=True))


def test_other_plates_around_and_inside():
    def program():
        with pyro.plate("scenes", N, dim=-2):
            derivation = derive(GRAMMAR, PRIOR, N, MAX_STEPS)
            for i in pyro.plate("lamps", 2):
                pyro.sample(f"lamp_{i}", dist.Normal(0.0, 1.0).expand([N, 1]))
            with pyro.plate("walls", 4, dim=-1):
                pyro.sample("wall", dist.Normal(0.0, 1.0))
        with pyro.plate("cities", 3, dim=-1):
            pyro.sample("city", dist.Normal(0.0, 1.0))
        return derivation

    trace = poutine.trace(program).get_trace()
    trace.compute_log_prob()
    assert trace.nodes["wall"]["value"].shape == (N, 4)
    assert trace.nodes["city"]["value"].shape == (3,)
    assert (trace.nodes["_RETURN"]["value"].complete).all()


def test_what_depends_on_what_can_be_drawn():
    """``pyro.render_model`` draws these relations with Graphviz."""
    torch.manual_seed(0)
    found = get_model_relations(measured)
    assert {"left", "plate.x"} <= set(found["sample_sample"]["read"])
    assert found["sample_sample"]["rule_0"] == []
    assert found["sample_sample"]["rule_2"] == ["rule_0", "rule_1"]
    assert found["plate_sample"]["nodes"] == ["plate.x", "read"]


def pickled(guide):
    return pickle.loads(pickle.dumps(guide))


def saved(guide):
    with io.BytesIO() as file:
        torch.save(guide, file)
        file.seek(0)
        return torch.load(file, weights_only=False)


def joint_guide():
    return ScenarioGuide(JointGrammar({"tables": GRAMMAR, "skies": OTHER.grammar}), MAX_STEPS + 1, hidden=4)


GUIDES = {kind: partial(make_guide, kind, GRAMMAR, MAX_STEPS) for kind in ("lstm", "pcfg", "grammar-vae")}
GUIDES["scenarios"] = joint_guide


@pytest.mark.parametrize("keep", [pickled, saved, copy.deepcopy])
@pytest.mark.parametrize("make", GUIDES.values(), ids=GUIDES)
def test_a_guide_that_svi_has_learnt_is_saved_and_goes_on(make, keep):
    pyro.clear_param_store()
    guide = make()

    def program(num_scenes):
        with pyro.plate("scenes", num_scenes, dim=-2):
            derivation = derive(guide.grammar, StructurePrior(guide.grammar), num_scenes, guide.max_steps)
            return SceneGraph(guide.grammar, derivation).draw()

    derivations = enumerate_derivations(guide.grammar, guide.max_steps)
    objective = ScoreFunction(lambda scenes: scenes.derivation.lengths.unsqueeze(1).float(), lambda g, _: g.sum(1))
    learn = SVI(program, guide, pyro.optim.Adam({"lr": 0.1}), objective)
    untrained = guide.log_prob(derivations)
    for _ in range(2):
        learn.step(8, real=None)
        kept = keep(guide)
        assert torch.equal(kept.log_prob(derivations), guide.log_prob(derivations))
    assert not torch.allclose(untrained, guide.log_prob(derivations))
    before = kept.log_prob(derivations)
    learn.step(8, real=None)
    assert torch.equal(kept.log_prob(derivations), before)


@pytest.mark.parametrize("make", [ParameterGuide, ParameterTransform])
@pytest.mark.parametrize("keep", [pickled, saved, copy.deepcopy])
def test_a_guide_of_parameters_is_saved_after_a_step(make, keep):
    pyro.clear_param_store()
    torch.manual_seed(0)
    structure = make_guide("pcfg", MODEL.grammar, MODEL.max_steps)
    guide = make(MODEL, tuple(site for site in find_sites(MODEL) if not site.keeps), structure)
    svi = SVI(lambda n: MODEL.program(n, MODEL.prior), guide, pyro.optim.Adam({"lr": 0.1}), Trace_ELBO())
    svi.step(4)
    kept = keep(guide)
    assert all(torch.equal(*pair) for pair in zip(kept.parameters(), guide.parameters(), strict=True))
    drawn = []
    for each in (guide, kept):
        torch.manual_seed(1)
        drawn.append(poutine.trace(each.program).get_trace(4, each.structure).log_prob_sum())
    assert torch.equal(*drawn)


@pytest.mark.parametrize("move", [lambda guide: guide.to("meta"), lambda guide: guide.cuda(),
                                  lambda guide: torch.nn.Sequential(guide).to("cuda")])  # fmt: skip
@pytest.mark.parametrize("kind", ["lstm", "pcfg"])
def test_guides_stay_on_the_cpu(kind, move):
    guide = make_guide(kind, GRAMMAR, MAX_STEPS)
    with pytest.raises(ModelError, match=r"expected a guide on the CPU, .*, got (meta|cuda|another device.*); leave"):
        move(guide)
    guide.double().to("cpu").log_prob(GIVEN)


def test_a_prior_is_saved_by_pickle():
    prior: Policy = StructurePrior(GRAMMAR, Plates=weights(1, 3))
    assert torch.equal(pickle.loads(pickle.dumps(prior)).log_prob(GIVEN), prior.log_prob(GIVEN))
