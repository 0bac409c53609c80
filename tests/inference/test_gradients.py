"""The score-function gradient against the exact one, on a grammar that can be enumerated."""

from dataclasses import replace

import pyro
import pytest
import torch

from probscene.enumeration import enumerate_derivations
from probscene.inference.divergence import MMD, JensenShannon, KDELogRatio
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.guides.pcfg import PCFG
from probscene.inference.guides.scenario import ScenarioGuide
from probscene.inference.objective import BASELINES, ScoreFunction, ScoreFunctionConfig
from probscene.scenarios import join
from probscene.structure import StructurePrior


def number_of_each(model):
    """Features of scenes: how many nodes of each kind they have."""
    return lambda scenes: scenes.derivation.counts(len(model.grammar.kinds)).float()


def gradients(loss, guide):
    for p in guide.parameters():
        p.grad = None
    loss.backward()
    return torch.cat([torch.zeros(p.numel()) if p.grad is None else p.grad.flatten() for p in guide.parameters()])


def assert_estimates(draw, exact):
    """The mean of eight estimates is the exact gradient, but for their error."""
    runs = torch.stack([draw() for _ in range(8)])
    mean, error = runs.mean(0), runs.std(0) / 8**0.5
    away = exact.abs() > 1e-3
    assert ((mean - exact).abs()[away] < 6 * error[away] + 1e-4).all()
    assert torch.nn.functional.cosine_similarity(mean, exact, 0) > 0.98


@pytest.mark.parametrize("latents", [1, 3])
@pytest.mark.parametrize("baseline", ["leave_one_out", "moving_average", "none"])
def test_gradient_is_the_exact_one(small, baseline, latents):
    pyro.set_rng_seed(1)
    guide = LSTMGuide(small.grammar, 4, hidden=8, num_latents=latents)
    log_q = guide.log_prob(small.derivations)
    exact = gradients((log_q.exp() * small.cost(small.features, None)).sum(), guide)
    loss = ScoreFunction(small.observe, small.cost, ScoreFunctionConfig(baseline=baseline))
    assert_estimates(lambda: gradients(loss(small.program, guide, 4000, real=None), guide), exact)


def test_kde_gradient_tends_to_the_enumerated_one(small):
    pyro.set_rng_seed(2)
    guide = LSTMGuide(small.grammar, 4, hidden=8)
    log_q = guide.log_prob(small.derivations)
    kernel = torch.exp(-0.5 * (small.features.unsqueeze(1) - small.features).square().sum(-1))
    cost = ((kernel @ log_q.exp()) / (kernel @ small.target)).log().detach()
    exact = gradients((log_q.exp() * cost).sum(), guide)
    real = small.features[torch.multinomial(small.target, 4000, replacement=True)]
    loss = ScoreFunction(small.observe, KDELogRatio(1.0, None))
    runs = torch.stack([gradients(loss(small.program, guide, 2000, real=real), guide) for _ in range(6)])
    assert torch.nn.functional.cosine_similarity(runs.mean(0), exact, 0) > 0.97


def lagging(loss, average):
    """With a moving average that has not followed the costs."""
    if loss.config.baseline == "moving_average":
        loss.averages, loss.config = {0: average, 1: average}, replace(loss.config, decay=1e-6)
    return loss


REDRAWN = {  # guides of which a fifth, a third and two thirds of the attempts fail
    "several latents": lambda grammar: LSTMGuide(grammar, 6, hidden=8, num_latents=3),
    "short": lambda grammar: LSTMGuide(grammar, 4, hidden=8),
    "long lists": lambda grammar: going_on(PCFG(grammar, 6), 1.5),
}


def going_on(guide, logit):
    with torch.no_grad():
        guide.weights[guide.grammar.rules_of("Things")[0]] = logit
    return guide


def cost_of(features):
    """Far from 0, and from a moving average that lags."""
    return features.sum(1) ** 2 + 2 * features[:, 0]


@pytest.mark.parametrize("make", REDRAWN.values(), ids=REDRAWN)
@pytest.mark.parametrize("baseline", BASELINES)
def test_the_gradient_of_the_cost_is_exact_where_derivations_are_redrawn(dots, baseline, make):
    pyro.set_rng_seed(8)
    guide = make(dots.grammar)
    derivations = enumerate_derivations(dots.grammar, guide.max_steps)
    q = guide.log_prob(derivations).exp()
    assert 0.1 < float(q.detach().sum()) < 0.85
    exact = gradients((q * cost_of(derivations.counts(len(dots.grammar.kinds)))).sum() / q.sum(), guide)
    loss = ScoreFunction(
        number_of_each(dots),
        lambda g, r: cost_of(g),
        ScoreFunctionConfig(baseline=baseline, reject_weight=0.0, incompletion_weight=0.0),
    )
    estimate = gradients(lagging(loss, -1.0)(dots, guide, 60_000, real=None), guide)
    assert float(torch.nn.functional.cosine_similarity(estimate, exact, 0)) >= 0.999
    assert float(estimate.norm() / exact.norm()) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("baseline", BASELINES)
def test_scenarios_that_are_redrawn_descend_each_its_own_mean_cost(dots, baseline):
    """However often a scenario fails: another one's costs say nothing of it."""
    pyro.set_rng_seed(9)
    model = join("dots", {"few": dots, "many": dots})
    joint = model.grammar
    makes = iter([-0.5, 2.0])
    guide = ScenarioGuide(joint, 7, make=lambda grammar, steps: going_on(PCFG(grammar, steps), next(makes)))
    derivations = enumerate_derivations(joint, 7)
    q, scenario = guide.log_prob(derivations).exp(), guide.strata(derivations)
    cost = cost_of(derivations.counts(len(joint.kinds)))
    share = torch.stack([q[scenario == s].sum() for s in (0, 1)])
    means = torch.stack([(q * cost)[scenario == s].sum() for s in (0, 1)]) / share
    exact = gradients(((share / share.sum()).detach() * means).sum(), guide)
    loss = ScoreFunction(
        number_of_each(model),
        lambda g, r: cost_of(g),
        ScoreFunctionConfig(baseline=baseline, reject_weight=0.0, incompletion_weight=0.0),
        strata=guide.strata,
    )
    estimate = gradients(lagging(loss, -1.0)(model, guide, 60_000, real=None), guide)
    assert float(torch.nn.functional.cosine_similarity(estimate, exact, 0)) >= 0.999
    assert float(estimate.norm() / exact.norm()) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("threshold", [0.0, 1.0, 2.5])
@pytest.mark.parametrize("costs", ["none", "fixed"])
def test_the_gradient_of_all_terms_is_exact_where_derivations_may_not_end(dots, costs, threshold):
    """Of the cost of scenes that ended, the probability of more failed attempts than the threshold, and half their
    squared number; two thirds of the derivations end."""
    pyro.set_rng_seed(6)
    guide = LSTMGuide(dots.grammar, 6, hidden=8)
    kinds = (
        torch.linspace(-1, 1.5, len(dots.grammar.kinds)) if costs == "fixed" else torch.zeros(len(dots.grammar.kinds))
    )
    derivations = enumerate_derivations(dots.grammar, 6)
    log_q = guide.log_prob(derivations)
    ends = log_q.exp().sum()
    assert 0.3 < float(ends.detach()) < 0.8
    failing = 1 - ends
    of_scene = (derivations.counts(len(dots.grammar.kinds)) * kinds).sum(1)
    expected = (log_q.exp() * of_scene).sum() / ends
    penalty = failing ** (int(threshold) + 1)
    exact = gradients(expected + 0.7 * penalty + 0.5 * 0.2 * (failing / ends) ** 2, guide)
    loss = ScoreFunction(
        number_of_each(dots),
        lambda g, r: (g * kinds).sum(1),
        ScoreFunctionConfig(reject_weight=0.7, reject_threshold=threshold, incompletion_weight=0.2),
    )
    runs = torch.stack([gradients(loss(dots, guide, 20_000, real=None), guide) for _ in range(6)])
    assert float(torch.nn.functional.cosine_similarity(runs.mean(0), exact, 0)) >= 0.999
    assert float(runs.mean(0).norm() / exact.norm()) == pytest.approx(1, abs=0.05)


def test_the_gradient_of_a_shared_mmd_is_exact_where_derivations_may_not_end(dots, monkeypatch):
    """Every pair of scenes is a batch, in proportion to its probability: with one reward for both, an estimate of
    random batches would take tens of thousands."""
    pyro.set_rng_seed(7)
    guide = LSTMGuide(dots.grammar, 6, hidden=8)
    derivations = enumerate_derivations(dots.grammar, 6)
    features = derivations.counts(len(dots.grammar.kinds)).float()
    real = features[torch.randint(len(features), (50,))]
    log_q = guide.log_prob(derivations)
    ends = log_q.exp().sum()
    q, failing = log_q.exp() / ends, 1 - ends
    kernel = torch.exp(-0.5 * (features.unsqueeze(1) - features).square().sum(-1))
    across = torch.exp(-0.5 * (features.unsqueeze(1) - real).square().sum(-1)).mean(1)
    penalties = 0.7 * failing**2 + 0.5 * 0.2 * (failing / ends) ** 2
    exact = gradients((q @ kernel @ q - 2 * q @ across) / 2 + penalties, guide)

    loss = ScoreFunction(
        number_of_each(dots),
        MMD(1.0),
        ScoreFunctionConfig(baseline="moving_average", decay=1e-06, reject_weight=0.7, incompletion_weight=0.2),
    )
    failed = (failing / ends).detach().expand(2)
    q, pairs = q.detach(), torch.cartesian_prod(*2 * [torch.arange(len(features))])
    mean = float(q @ kernel @ q - 2 * q @ across) + float(
        torch.exp(-0.5 * (real.unsqueeze(1) - real).square().sum(-1)).fill_diagonal_(0).sum() / (50 * 49)
    )
    found, drawn = torch.zeros_like(exact), "probscene.inference.objective.derive_complete"
    for pair in pairs:
        monkeypatch.setattr(drawn, lambda *_, pair=pair, **__: (derivations[pair], failed))
        loss.averages, loss.batch = {0: mean}, None
        found += q[pair].prod() * gradients(loss(dots, guide, 2, real=real), guide)
    assert 0.2 < float(ends.detach()) < 0.9 and len(features) > 4
    assert float(torch.nn.functional.cosine_similarity(found, exact, 0)) >= 0.999
    assert float(found.norm() / exact.norm()) == pytest.approx(1, abs=0.01)


OBJECTIVES = {
    "kde": KDELogRatio(1.0, None),
    "kde and marginals": KDELogRatio(1.0, 0.3),
    "js": JensenShannon(1.0, 0.3),
    "witness": MMD(1.0, shared=False),
}


@pytest.mark.parametrize("objective", OBJECTIVES.values(), ids=OBJECTIVES)
def test_the_gradient_of_each_objective_is_exact_where_derivations_may_not_end(dots, objective):
    """With the penalties, and densities that are sums over all derivations, of which a fifth do not end."""
    pyro.set_rng_seed(6)
    guide = LSTMGuide(dots.grammar, 6, hidden=8)
    derivations = enumerate_derivations(dots.grammar, 6)
    features = derivations.counts(len(dots.grammar.kinds)).float()
    target = torch.distributions.Dirichlet(torch.ones(len(features))).sample()
    log_q = guide.log_prob(derivations)
    ends = log_q.exp().sum()
    failing, of_ended = 1 - ends, (log_q.exp() / ends).detach()

    def densities(x, variance):
        kernel = torch.exp(-0.5 / variance * (x.unsqueeze(1) - x).square().sum(-1))
        return kernel @ of_ended, kernel @ target

    def ratio(x, variance):
        own, real = densities(x, variance)
        return objective.cost_of_log_ratio((own / real).log())

    if isinstance(objective, MMD):
        own, real = densities(features, objective.variance)
        cost = 2 * (own - real)
    else:
        marginal = objective.marginal_variance
        cost = ratio(features, objective.variance)
        cost = cost + (0 if marginal is None else sum(ratio(x, marginal) for x in features.T.unsqueeze(-1)))
    expected = (log_q.exp() * cost).sum() / ends
    exact = gradients(expected + 0.7 * failing**2 + 0.5 * 0.2 * (failing / ends) ** 2, guide)
    loss = ScoreFunction(
        number_of_each(dots),
        objective,
        ScoreFunctionConfig(reject_weight=0.7, reject_threshold=1.0, incompletion_weight=0.2),
    )

    def estimate():
        real = features[torch.multinomial(target, 4000, replacement=True)]
        return gradients(loss(dots, guide, 4000, real=real), guide)

    mean = torch.stack([estimate() for _ in range(6)]).mean(0)
    assert float(torch.nn.functional.cosine_similarity(mean, exact, 0)) >= 0.999
    assert float(mean.norm() / exact.norm()) == pytest.approx(1, abs=0.05)


def test_what_failed_attempts_cost_is_not_scaled(dots):
    """The paper scales the log ratio, and gives the penalty a weight of its own."""
    grads = []
    for scale in (1.0, 1e-2):
        pyro.set_rng_seed(7)
        guide = LSTMGuide(dots.grammar, 6, hidden=8)
        loss = ScoreFunction(
            lambda scenes: torch.zeros(len(scenes.failures), 1),
            lambda g, r: torch.zeros(len(g)),
            ScoreFunctionConfig(scale=scale),
        )
        grads.append(gradients(loss(dots, guide, 500, real=None), guide))
    assert grads[0].any() and torch.equal(*grads)


def test_leaked_probability_is_drawn_back(dots):
    """The gradient of half the squared number of failed attempts, exactly: of a truncated grammar's complete part."""
    pyro.set_rng_seed(3)
    guide = LSTMGuide(dots.grammar, 6, hidden=8)
    complete = guide.log_prob(enumerate_derivations(dots.grammar, 6)).exp().sum()
    failures = (1 - complete) / complete
    assert failures > 0.05
    exact = gradients(0.5 * 3.0 * failures**2, guide)
    loss = ScoreFunction(
        lambda scenes: torch.zeros(len(scenes.failures), 1),
        lambda g, r: torch.zeros(len(g)),
        ScoreFunctionConfig(reject_weight=0.0, incompletion_weight=3.0),
    )
    assert_estimates(lambda: gradients(loss(dots, guide, 4000, real=None), guide), exact)


def test_an_anchor_draws_toward_its_policy(small):
    """The gradient of the weighted KL from the anchor, exactly."""
    pyro.set_rng_seed(4)
    guide, prior = LSTMGuide(small.grammar, 4, hidden=8), StructurePrior(small.grammar)
    log_q = guide.log_prob(small.derivations)
    exact = gradients(0.5 * (log_q.exp() * (log_q - prior.log_prob(small.derivations))).sum(), guide)
    loss = ScoreFunction(
        small.observe, lambda g, r: torch.zeros(len(g)), ScoreFunctionConfig(prior_kl_weight=0.5), prior=prior
    )
    assert_estimates(lambda: gradients(loss(small.program, guide, 4000, real=None), guide), exact)
