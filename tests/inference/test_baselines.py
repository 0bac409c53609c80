"""The learnt PCFG and the Grammar VAE: what they learn, and what either cannot express."""

import math

import pyro
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro import poutine

from probscene.derive import derive, derive_complete
from probscene.enumeration import enumerate_derivations
from probscene.errors import ProbsceneError
from probscene.grammar import Grammar
from probscene.inference.divergence import KDELogRatio
from probscene.inference.guides.grammar_vae import GrammarVAE
from probscene.inference.guides.lstm import GUIDES, LSTMGuide, make_guide
from probscene.inference.guides.pcfg import PCFG
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
from probscene.inference.pretrain import pretrain
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.scene import SceneGraph
from probscene.structure import StructurePrior, counts, ranked, weights

FLAT = Grammar("Scene -> A B | x\nA -> y(B) | z\nB -> y | B2 | ε\nB2 -> x | y")  # 21 derivations
LISTS = Grammar("Scene -> bg Items\nItems -> Item Items | ε\nItem -> x(Things) | y\nThings -> z Things | ε")
COIN = Grammar("Scene -> Side Side\nSide -> x | y")
SHELVES = Grammar("Scene -> Shelves\nShelves -> shelf(Cups) Shelves | ε\nCups -> cup Cups | ε")


@st.composite
def grammar_vaes(draw, grammar):
    """With random weights throughout."""
    torch.manual_seed(draw(st.integers(0, 2**31)))
    guide = GrammarVAE(grammar, 9, draw(st.integers(1, 6)), draw(st.sampled_from([1, 2, 5])), latent_size=3)
    for parameter in guide.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    return guide


def derived(guide, seed, num_scenes=6):
    pyro.set_rng_seed(seed)
    trace = poutine.trace(guide).get_trace(num_scenes)
    return trace, trace.nodes["_RETURN"]["value"]


def entropy(p):
    return torch.special.entr(p).sum().item()


@given(grammar_vaes(LISTS), st.integers(0, 2**31))
def test_the_grammar_vae_is_a_mixture_whose_parts_read_no_rule(guide, seed):
    """Every part gives all derivations the logits of the step's number; their mean probability is q."""
    _, derivation = derived(guide, seed)
    logits = torch.stack([guide.logits(derivation, z) for z in range(len(guide.latents))])
    assert torch.equal(logits, logits[:, :1].expand_as(logits))
    symbol, rules = derivation.frontier.symbol, derivation.rules
    legal = LISTS.legal[symbol]
    probs = torch.softmax(logits.where(legal, -torch.inf), -1)
    chosen = probs.gather(-1, rules.clamp(min=0).expand(len(logits), *rules.shape).unsqueeze(-1)).squeeze(-1)
    each = chosen.where(rules >= 0, 1.0).prod(-1)
    torch.testing.assert_close(each.mean(0).log(), guide.log_prob(derivation), rtol=1e-4, atol=1e-4)


def test_several_latent_vectors_tie_what_one_cannot():
    """Two sides that are always alike: one latent vector gives two independent coins at best, several give one."""
    alike = torch.tensor([0.5, 0.0, 0.0, 0.5])  # xx, xy, yx, yy
    every = enumerate_derivations(COIN, 3)
    nll = {}
    for latents in (1, 8):
        torch.manual_seed(0)
        guide = GrammarVAE(COIN, 3, hidden=16, num_latents=latents, latent_size=8)
        optimiser = torch.optim.Adam(guide.parameters(), lr=2e-2)
        for _ in range(200):
            optimiser.zero_grad()
            loss = -(alike * guide.log_prob(every)).sum()
            loss.backward()
            optimiser.step()
        nll[latents] = loss.item()
    assert nll[1] == pytest.approx(2 * math.log(2), abs=1e-3)
    assert nll[8] < 1.2 * math.log(2)


def test_pretraining_a_pcfg_comes_to_the_rule_frequencies():
    prior = StructurePrior(FLAT, Scene=weights(3, 1), A=weights(1, 4), B=weights(1, 2, 5), B2=weights(2, 1))
    pyro.set_rng_seed(0)
    guide = PCFG(FLAT, 9)
    pretrain(guide, prior, num_derivations=2000, epochs=150, batch_size=2000, learning_rate=0.1)
    pyro.set_rng_seed(0)
    data, _ = derive_complete(FLAT, prior, 2000, 9)  # what it was trained on
    for name in FLAT.nonterminals:
        rules = FLAT.rules_of(name)
        used = torch.stack([(data.rules == k).sum() for k in rules]).float()
        learnt = torch.softmax(guide.weights.detach()[rules], 0)
        assert torch.allclose(learnt, used / used.sum(), atol=0.005), name


def best_context_free(grammar, derivations, p):
    """Log-probabilities of the context-free weights with the best likelihood: each rule's share of its nonterminal's
    expected expansions."""
    used = torch.stack([(p * (derivations.rules == k).sum(1)).sum() for k in range(len(grammar.rules))])
    log_share = torch.empty(len(grammar.rules), dtype=torch.float64)
    for name in grammar.nonterminals:
        rules = grammar.rules_of(name)
        log_share[rules] = (used[rules] / used[rules].sum()).log()
    return log_share


def test_a_pcfg_cannot_express_context_and_the_lstm_can():
    """The first shelf has two cups, any other none: a PCFG stays at the cross-entropy that its closed form has, above
    the entropy; the LSTM comes to the entropy."""
    context = StructurePrior(SHELVES, Shelves=counts(0, 1, 1, 1), Cups=ranked(counts(0, 0, 1), counts(1)))
    every = enumerate_derivations(SHELVES, 12)
    p = context.log_prob(every).double().exp()
    assert p.sum().item() == pytest.approx(1) and entropy(p) == pytest.approx(math.log(3))
    log_share = best_context_free(SHELVES, every, p)
    used = torch.stack([(p * (every.rules == k).sum(1)).sum() for k in range(len(SHELVES.rules))])
    bound = -(used * log_share).sum().item()
    nll = {}
    for kind, rate in (("pcfg", 3e-2), ("lstm", 1e-2)):
        torch.manual_seed(0)
        guide = make_guide(kind, SHELVES, 12)
        optimiser = torch.optim.Adam(guide.parameters(), lr=rate)
        for _ in range(200):
            optimiser.zero_grad()
            loss = -(p * guide.log_prob(every)).sum()
            loss.backward()
            optimiser.step()
        nll[kind] = loss.item()
    assert nll["pcfg"] == pytest.approx(bound, abs=1e-3) and bound > entropy(p) + 2
    assert nll["lstm"] < entropy(p) + 0.05


def test_the_score_function_brings_a_pcfg_to_the_closed_form():
    """The quick preset's settings (Adam 1e-2 along a cosine, three clipped steps a batch) and true counts as features:
    a list of one kind with two rules, whose best context-free weights have a closed form. As many real as generated
    scenes, as the tail of a list without an end is rarer in the smaller sample, and its density ratio biased."""
    grammar = Grammar("Scene -> Items\nItems -> x Items | ε")
    truth = StructurePrior(grammar, Items=weights(3, 1))
    pyro.set_rng_seed(0)

    def counted(derivation):
        return derivation.counts(1).float()

    real = counted(derive_complete(grammar, truth, 5000, 40)[0])
    guide = PCFG(grammar, 40)
    pretrain(guide, StructurePrior(grammar, Items=counts(1, 1, 1, 1)), 500, 5, learning_rate=3e-2)

    def program(num_scenes, structure=truth):
        with pyro.plate("scenes", num_scenes, dim=-2):
            return SceneGraph(grammar, derive(grammar, structure, num_scenes, 40)).draw()

    objective = ScoreFunction(lambda scenes: counted(scenes.derivation), KDELogRatio(), ScoreFunctionConfig(updates=3))
    StructureTraining(
        program, guide, objective, real, StructureSchedule(batches=60, num_scenes=500, num_real=500)
    ).run()
    again = torch.softmax(guide.weights.detach()[grammar.rules_of("Items")], 0)[0].item()
    closed = 1 - 1 / (1 + real.mean().item())  # a repeat's share of all expansions of Items
    assert again == pytest.approx(closed, abs=0.02)


@pytest.mark.parametrize("kind", ["lstm", "grammar-vae"])
def test_the_score_function_learns_what_needs_context(small, kind):
    torch.manual_seed(1)
    guide = make_guide(kind, small.grammar, 4)

    def distance():
        with torch.no_grad():
            return 0.5 * (guide.log_prob(small.derivations).exp() - small.target).abs().sum().item()

    before = distance()
    real = small.features[torch.multinomial(small.target, 3000, replacement=True)]

    def counted(scenes):
        return scenes.derivation.counts(len(small.grammar.kinds)).float()

    objective = ScoreFunction(counted, KDELogRatio(0.2, None), ScoreFunctionConfig(updates=3))
    StructureTraining(small.program, guide, objective, real, StructureSchedule(batches=60, num_scenes=300)).run()
    assert distance() < 0.12 < before


def test_make_guide():
    assert [type(make_guide(kind, COIN, 5)) for kind in GUIDES] == [LSTMGuide, PCFG, GrammarVAE]
    assert len(make_guide("grammar-vae", COIN, 5, num_latents=7).latents) == 7
    with pytest.raises(ProbsceneError, match="lstm, pcfg, grammar-vae, got 'hmm'"):
        make_guide("hmm", COIN, 5)


def test_a_grammar_vae_has_no_logits_beyond_its_last_step():
    guide = GrammarVAE(LISTS, max_steps=6)
    with pytest.raises(ProbsceneError, match="at most max_steps = 6 rules, got 8"):
        guide.log_prob(enumerate_derivations(LISTS, 8))
