"""``derive``, the one Pyro program behind prior, PCFG and guide (Meta-Sim2, section 3.2).

Each step samples the rule of the next nonterminal at the site ``rule_t`` from a Categorical whose illegal rules are
masked. Axis letters: N scenes, T steps.
"""

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from .derivation import Derivation, expand
from .errors import SamplingError
from .grammar import Grammar
from .policy import Policy, masked


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
        rule = dist.Categorical(logits=masked(grammar, logits, frontier.symbol).unsqueeze(-2), validate_args=False)
        value = pyro.sample(f"rule_{t}", rule.mask(active.unsqueeze(-1))).squeeze(-1)
        return value.where(active, -1)

    return expand(grammar, choose, num_scenes, max_steps)


def derive_complete(
    grammar: Grammar, policy: Policy, num_scenes: int, max_steps: int, attempts: int = 100
) -> tuple[Derivation, Tensor]:
    """Derivations that are all complete: what is longer than ``max_steps`` is redrawn (section 3.3). No Pyro sites.

    Returns:
        The derivations, and the failed attempts of each scene ``(N,)`` int64.

    Raises:
        SamplingError: some scene failed ``attempts`` times.
    """
    rules = torch.full((num_scenes, max_steps), -1)
    failures = torch.zeros(num_scenes, dtype=torch.int64)
    todo = torch.arange(num_scenes)
    with torch.no_grad(), pyro.poutine.block():
        for _ in range(attempts):
            if not len(todo):
                break
            drawn = derive(grammar, policy, len(todo), max_steps)
            done = todo[drawn.complete]
            rules[done] = -1
            rules[done, : drawn.rules.shape[1]] = drawn.rules[drawn.complete]
            todo = todo[~drawn.complete]
            failures[todo] += 1
    if len(todo):
        raise SamplingError(
            f"Expected every scene to end within max_steps = {max_steps}, actual {len(todo)} of {num_scenes} scenes "
            f"still open after {attempts} attempts; raise max_steps or make the lists shorter."
        )
    longest = int((rules >= 0).sum(1).max()) if num_scenes else 0
    return Derivation.of(grammar, rules[:, : max(1, longest)]), failures
