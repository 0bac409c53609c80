"""``derive``, the one Pyro program behind prior, PCFG and guide (Meta-Sim2, section 3.2).

Each step samples the rule of the next nonterminal at the site ``rule_t`` from a Categorical whose illegal rules are
masked. ``ConditionDerivation`` is an effect handler that hands ``derive`` what is derived already. Axis letters: N
scenes, T steps.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import pyro
import torch
from pyro.ops.provenance import detach_provenance, get_provenance, track_provenance
from pyro.poutine.indep_messenger import IndepMessenger
from pyro.poutine.mask_messenger import MaskMessenger
from pyro.poutine.messenger import Messenger
from pyro.poutine.runtime import _PYRO_STACK, effectful
from torch import Tensor

from .derivation import Chooser, Derivation, Frontier, expand, tensor_chooser
from .errors import ModelError, SamplingError
from .grammar import Grammar
from .policy import Policy, masked
from .rules import Choice, RuleCategorical

RULE = "rule"  # of sites, before _0


@effectful(type="derive")
def _derived(grammar: Grammar, choose: Chooser, num_scenes: int, max_steps: int) -> Derivation:
    """``expand``, unless a handler has the derivations. Its message has a name, which users' handlers may ask for."""
    return expand(grammar, choose, num_scenes, max_steps)


_effect = cast(Callable[..., Derivation], _derived)  # which takes a name as well


class ConditionDerivation(Messenger):
    """Inside it ``derive`` gives derivations that are known: the stack machine does not run, and no ``rule_t`` is a
    site. A program that derives scenes of another grammar, under another name, or another number of them, still
    samples.

    Args:
        grammar: whose derivations they are.
        derivation: the derivations, ``(N, T)``.
        any_length: whether they may be longer than the program's own ``max_steps``.
    """

    def __init__(self, grammar: Grammar, derivation: Derivation, any_length: bool = False):
        super().__init__()
        self.grammar, self.derivation, self.any_length = grammar, derivation.trimmed(), any_length

    def _pyro_derive(self, msg):
        grammar, _, num_scenes, max_steps = msg["args"]
        others = msg["name"] != _message(RULE) or num_scenes != len(self.derivation)
        if msg["done"] or others or grammar.rules != self.grammar.rules:
            return
        longest = self.derivation.rules.shape[1]
        if longest > max_steps and not self.any_length:
            raise ModelError(
                f"expected the program to derive with a max_steps of at least {longest}, the rules of the longest of "
                f"these scenes, got max_steps = {max_steps}: it would draw fewer objects than they have. Give "
                "derive(...) the max_steps of the SceneModel, or say it once with scene_model."
            )
        msg["value"], msg["done"] = self.derivation, True


def derive(
    grammar: Grammar, policy: Policy, num_scenes: int, max_steps: int, *, name: str = RULE, static: bool = False
) -> Derivation:
    """Sample derivations: a Pyro program with sites ``rule_0``, ``rule_1``, ... of shape ``(N, 1)``.

    Call it inside ``pyro.plate("scenes", num_scenes, dim=-2)``. It stops when every scene is complete, at the latest
    after ``max_steps``; what is not complete by then says so in ``Derivation.complete``, for the caller to redraw.
    Sites are left out where nothing but plates would hear of them; one seed draws the same.

    Args:
        policy: the structure prior, a PCFG, or a guide.
        name: of its sites, before ``_0``. A program that derives several times names all but one, which is that of the
            ``SceneModel``.
        static: make ``max_steps`` sites in every call, masked after the last rule, for what needs the same sites in
            every call, such as autoguides. Where no density is asked for, as in ``Predictive``, it is so without
            asking, and there are columns for the most nodes that such a derivation can have.

    Raises:
        ModelError: it is called under a plate of another shape, for vectorised particles or enumeration; a handler
            gives a rule that does not expand the nonterminal.
    """
    if _unheard() and not static:
        return _effect(grammar, Choice(grammar, policy, num_scenes), num_scenes, max_steps, name=_message(name))
    memory, done = policy.start(num_scenes), 0
    before = frozenset()  # what the rules depend on, which is lost in ``expand``

    def choose(t: int, frontier: Frontier, previous: Tensor) -> Tensor:
        nonlocal memory, done, before
        logits, memory = policy.step(memory, frontier, previous)
        active, done = frontier.symbol < len(grammar.nonterminals), t + 1
        allowed = track_provenance(masked(grammar, logits, frontier, policy.support), before)
        rule = RuleCategorical(logits=allowed.unsqueeze(-2), validate_args=False)
        with _Sampled():
            value = pyro.sample(f"{name}_{t}", rule.mask(active.unsqueeze(-1)))
        before |= get_provenance(value)
        value = detach_provenance(value)
        _check(grammar, f"{name}_{t}", value, frontier)
        return value.squeeze(-1)

    derivation = _effect(grammar, tensor_chooser(choose), num_scenes, max_steps, name=_message(name))
    given = done == 0  # by a handler
    if _without_density():
        static = not given
        derivation = derivation.padded(grammar, 0, max_steps * grammar.objects.shape[1])
    for t in range(done, max_steps if static else done):
        nothing = RuleCategorical(logits=torch.zeros(num_scenes, 1, len(grammar.rules)), validate_args=False)
        pyro.sample(f"{name}_{t}", nothing.mask(torch.zeros(num_scenes, 1, dtype=torch.bool)))
    nodes = {key: track_provenance(getattr(derivation, key), before) for key in ("kind", "parent")}
    return replace(derivation, **nodes) if before else derivation


def _message(name: str) -> str:
    return f"derive_{name}"


def _unheard() -> bool:
    """Whether nothing but plates would hear of a site."""
    return all(isinstance(handler, IndepMessenger) for handler in _PYRO_STACK)


def _without_density() -> bool:
    """Whether all densities are masked, as in ``Predictive``, which stacks the values of many calls."""
    return any(isinstance(handler, MaskMessenger) and handler.mask is False for handler in _PYRO_STACK)


class _Sampled(Messenger):
    """Sees that a rule's site is not to be enumerated one value after the other, which Pyro does with one value in all
    scenes."""

    def _pyro_post_sample(self, msg):
        if msg["infer"].get("enumerate") == "sequential":
            raise ModelError(
                f"expected site {msg['name']!r} to be sampled, got sequential enumeration; for a sum over "
                "structures take enumerate_derivations(grammar, max_steps), and to enumerate other sites name them "
                "alone: pyro.sample(..., infer={'enumerate': 'parallel'})."
            )


def _check(grammar: Grammar, site: str, value: Tensor, frontier: Frontier) -> None:
    """See that a site has one rule a scene, which expands its nonterminal."""
    shape = len(frontier.symbol), 1
    if value.shape != shape:
        raise ModelError(
            f"expected site {site!r} of shape {shape}, one rule a scene, got {tuple(value.shape)}. Call derive "
            f"inside pyro.plate('scenes', {shape[0]}, dim=-2), and outside vectorised particles and enumeration: take "
            "num_particles without vectorize_particles, Predictive without parallel, and for a sum over structures "
            "enumerate_derivations(grammar, max_steps)."
        )
    rule = value.squeeze(-1)
    wrong = ~grammar.legal[frontier.symbol, rule] & (frontier.symbol < len(grammar.nonterminals))
    if wrong.any():
        i = int(wrong.nonzero()[0])
        raise ModelError(
            f"expected at site {site!r} a rule of {grammar.nonterminals[int(frontier.symbol[i])]} in scene {i}, got "
            f"{int(rule[i])} ({grammar.rules[int(rule[i])]}); condition on Derivation.sites(), and for a sum over "
            "structures take enumerate_derivations(grammar, max_steps)."
        )


def derive_complete(
    grammar: Grammar,
    policy: Policy,
    num_scenes: int,
    max_steps: int,
    attempts: int = 100,
    failed: list[Derivation] | None = None,
) -> tuple[Derivation, Tensor]:
    """Derivations that are all complete: what is longer than ``max_steps`` is redrawn (section 3.3). No Pyro sites.

    Args:
        failed: takes the derivations of the failed attempts, which are not complete.

    Returns:
        The derivations, and the failed attempts of each scene ``(N,)`` int64.

    Raises:
        SamplingError: some scene failed ``attempts`` times.
    """
    failures = torch.zeros(num_scenes, dtype=torch.int64)
    todo, parts = torch.arange(num_scenes), []
    with torch.no_grad(), pyro.poutine.block():
        for _ in range(attempts):
            if not len(todo):
                break
            drawn = _effect(grammar, Choice(grammar, policy, len(todo)), len(todo), max_steps, name=_message(RULE))
            parts.append((todo[drawn.complete], drawn[drawn.complete]))
            if failed is not None and not drawn.complete.all():
                failed.append(drawn[~drawn.complete])
            todo = todo[~drawn.complete]
            failures[todo] += 1
    if len(todo):
        raise SamplingError(
            f"expected every scene to end within max_steps = {max_steps}, got {len(todo)} of {num_scenes} scenes "
            f"still open after {attempts} attempts; raise max_steps or make the lists shorter."
        )
    if not parts:
        return Derivation.from_rules(grammar, torch.full((0, 1), -1)), failures
    return Derivation.merged(grammar, parts).trimmed(), failures
