"""``derive``, the one Pyro program behind prior, PCFG and guide (Meta-Sim2, section 3.2).

Each step samples the rule of the next nonterminal at the site ``rule_t`` from a Categorical whose illegal rules are
masked. ``Given`` is an effect handler that hands ``derive`` what is derived already. Axis letters: N scenes, T steps.
"""

from collections.abc import Callable

import pyro
import pyro.distributions as dist
import torch
from pyro.poutine.messenger import Messenger
from pyro.poutine.runtime import effectful
from torch import Tensor

from .derivation import Derivation, expand
from .errors import ModelError, SamplingError
from .grammar import Grammar
from .policy import Policy, masked


@effectful(type="derive")
def _derived(grammar: Grammar, choose: Callable[..., Tensor], num_scenes: int, max_steps: int) -> Derivation:
    """``expand``, unless a handler has the derivations."""
    return expand(grammar, choose, num_scenes, max_steps)


class Given(Messenger):
    """Inside it ``derive`` gives derivations that are known: the stack machine does not run, and no ``rule_t`` is a
    site. A program that derives scenes of another grammar, or another number of them, still samples.

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
        if msg["done"] or num_scenes != len(self.derivation) or grammar.rules != self.grammar.rules:
            return
        longest = self.derivation.rules.shape[1]
        if longest > max_steps and not self.any_length:
            raise ModelError(
                f"Expected the program to derive with a max_steps of at least {longest}, the rules of the longest of "
                f"these scenes, actual max_steps = {max_steps}: it would draw fewer objects than they have. Give "
                "derive(...) the max_steps of the SceneModel, or say it once with scene_model."
            )
        msg["value"], msg["done"] = self.derivation, True


def derive(grammar: Grammar, policy: Policy, num_scenes: int, max_steps: int) -> Derivation:
    """Sample derivations: a Pyro program with sites ``rule_0``, ``rule_1``, ... of shape ``(N, 1)``.

    Call it inside ``pyro.plate("scenes", num_scenes, dim=-2)``. It stops when every scene is complete, at the latest
    after ``max_steps``; what is not complete by then says so in ``Derivation.complete``, for the caller to redraw.

    Args:
        policy: the structure prior, a PCFG, or a guide.
    """
    memory = policy.start(num_scenes)

    def choose(t, frontier, previous):
        nonlocal memory
        logits, memory = policy.step(memory, frontier, previous)
        active = frontier.symbol < len(grammar.nonterminals)
        allowed = masked(grammar, logits, frontier, policy.support)
        rule = dist.Categorical(logits=allowed.unsqueeze(-2), validate_args=False)
        value = pyro.sample(f"rule_{t}", rule.mask(active.unsqueeze(-1))).squeeze(-1)
        return value.where(active, -1)

    return _derived(grammar, choose, num_scenes, max_steps)


def derive_complete(
    grammar: Grammar, policy: Policy, num_scenes: int, max_steps: int, attempts: int = 100
) -> tuple[Derivation, Tensor]:
    """Derivations that are all complete: what is longer than ``max_steps`` is redrawn (section 3.3). No Pyro sites.

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
            drawn = derive(grammar, policy, len(todo), max_steps)
            parts.append((todo[drawn.complete], drawn[drawn.complete]))
            todo = todo[~drawn.complete]
            failures[todo] += 1
    if len(todo):
        raise SamplingError(
            f"Expected every scene to end within max_steps = {max_steps}, actual {len(todo)} of {num_scenes} scenes "
            f"still open after {attempts} attempts; raise max_steps or make the lists shorter."
        )
    if not parts:
        return Derivation.of(grammar, torch.full((0, 1), -1)), failures
    return Derivation.merged(grammar, parts).trimmed(), failures
