"""What the guides share: the Pyro program around a policy, and ``|Z|`` latent vectors that are summed out exactly.

A mixture over a finite set of fixed latent vectors keeps ``q(T) = 1/|Z| sum_z q(T|z)`` a plain sum, so that neither the
score function nor maximum likelihood needs a bound (Meta-Sim2, section 3.3).
"""

import math
from collections.abc import Callable
from typing import Any, Self

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn

from probscene.derivation import Derivation
from probscene.derive import derive
from probscene.errors import ModelError
from probscene.grammar import Grammar
from probscene.policy import Policy, rule_log_probs
from probscene.support import Support


class GuideModule(nn.Module):
    """A module that Pyro learns: it is pickled, saved and copied as any other, and stays on the CPU."""

    def __getstate__(self) -> dict[str, Any]:
        for parameter in self.parameters():  # Pyro's weak references cannot be pickled; it makes them when it reads
            vars(parameter).pop("unconstrained", None)
        return self.__dict__

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """What ``to``, ``cuda`` and ``double`` do to all tensors.

        Raises:
            ModelError: it moves them to another device.
        """
        try:
            device = fn(torch.zeros(0)).device.type
        except (RuntimeError, AssertionError):  # there is no such device
            device = "another device, which this machine lacks"
        if device != "cpu":
            raise ModelError(
                f"expected a guide on the CPU, where structures are derived and learnt, got {device}; leave the "
                "guide there."
            )
        return super()._apply(fn, recurse)


class Guide(GuideModule, Policy):
    """A policy that learns, and a Pyro program: ``guide(num_scenes)`` derives scenes inside the plate ``"scenes"``.

    Args:
        grammar: the grammar.
        max_steps: T_max.
    """

    def __init__(self, grammar: Grammar, max_steps: int):
        super().__init__()
        self.grammar, self.max_steps = grammar, max_steps

    def forward(self, num_scenes: int) -> Derivation:
        """The Pyro program of the guide: sites ``z`` (where there are several latent vectors) and ``rule_t``."""
        pyro.module("guide", self)
        with pyro.plate("scenes", num_scenes, dim=-2):
            return derive(self.grammar, self, num_scenes, self.max_steps)

    def bind(self, support: Support | None) -> None:
        """Take no rule outside ``support`` from now on, such as ``SceneModel.support``; None unbinds."""
        self.support = support

    def strata(self, derivation: Derivation) -> Tensor:
        """``(N,)`` int64: scenes whose costs have a baseline together; all, unless there is a guide a scenario."""
        return torch.zeros(len(derivation), dtype=torch.int64)


class LatentGuide(Guide):
    """A guide with a buffer ``latents (Z, size)``; subclasses register it and give ``logits`` for each."""

    latents: Tensor

    def draw_latents(self, num_scenes: int) -> Tensor:
        """Which latent vector each scene has, ``(N,)``, by the site ``z`` where there are several."""
        Z = len(self.latents)
        if Z == 1:
            return torch.zeros(num_scenes, dtype=torch.int64)
        uniform = dist.Categorical(logits=torch.zeros(num_scenes, 1, Z))
        return pyro.sample("z", uniform).squeeze(-1)

    def logits(self, derivation: Derivation, latent: int = 0) -> Tensor:
        """``(N, T, K)`` given latent vector number ``latent``."""
        raise TypeError(f"expected a guide with a 'logits' method, got {type(self).__name__}.")

    def log_prob_each(self, derivation: Derivation) -> Tensor:
        """``log q(T|z)``, ``(Z, N)``."""
        each = (self.logits(derivation, z) for z in range(len(self.latents)))
        return torch.stack([rule_log_probs(self.grammar, one, derivation, self.support).sum(1) for one in each])

    def log_prob(self, derivation: Derivation) -> Tensor:
        """``log q(T)``, ``(N,)``, marginal over the latent vectors."""
        each = self.log_prob_each(derivation)
        return torch.logsumexp(each, 0) - math.log(len(each))
