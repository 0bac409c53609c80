"""The decoder of the Grammar VAE: every logit from z at once, the baseline without feedback [1].

A recurrent network unrolled from z alone gives T x K logits before any rule is sampled; beside z and the number of the
step the mask of legal rules is the only context.

Departures from [1]: z comes from a fixed sample Z of its Gaussian prior, so that q(T) is an exact sum instead of a
bound and there is no encoder to train; one recurrent layer instead of three.

References:
    [1] Kusner, Paige, Hernandez-Lobato, *Grammar Variational Autoencoder*, ICML 2017, section 3.2.
"""

import torch
from torch import Tensor, nn

from probscene.derivation import Derivation, Frontier
from probscene.errors import ProbsceneError
from probscene.grammar import Grammar

from .base import LatentGuide


class GrammarVAE(LatentGuide):
    """Logits ``(Z, T, K)`` of all latent vectors at once; scenes only look them up.

    Args:
        grammar: the grammar.
        max_steps: T_max; there are no logits beyond it.
        hidden: units of the dense and of the recurrent layer.
        num_latents: ``|Z|``.
        latent_size: length of a latent vector; 56 in [1].
    """

    def __init__(
        self, grammar: Grammar, max_steps: int, hidden: int = 100, num_latents: int = 32, latent_size: int = 56
    ):
        super().__init__(grammar, max_steps)
        self.register_buffer("latents", torch.randn(num_latents, latent_size))
        self.dense = nn.Linear(latent_size, hidden)
        self.cell = nn.GRU(hidden, hidden, batch_first=True)
        self.out = nn.Linear(hidden, len(grammar.rules))

    def start(self, num_scenes: int) -> tuple[Tensor, int]:
        """Each scene's logits ``(N, T, K)``, and the step."""
        return self._unroll(self.latents)[self.draw_latents(num_scenes)], 0

    def step(self, memory: tuple[Tensor, int], frontier: Frontier, previous_rule: Tensor):
        """The logits of this step; nothing that was sampled is read."""
        logits, t = memory
        return logits[:, t], (logits, t + 1)

    def logits(self, derivation: Derivation, latent: int = 0) -> Tensor:
        """``(N, T, K)`` given latent vector number ``latent``.

        Raises:
            ProbsceneError: derivations longer than ``max_steps``.
        """
        N, T = derivation.rules.shape
        return self._unroll(self.latents[latent : latent + 1])[:, : self._steps(T)].expand(N, -1, -1)

    def log_prob_each(self, derivation: Derivation) -> Tensor:
        """``log q(T|z)``, ``(Z, N)``: as the logits know no scene, they are normalised once for all of them."""
        if self.support is not None and self.support.prior_table is not None:
            return super().log_prob_each(derivation)
        rules = derivation.rules
        T = self._steps(rules.shape[1])
        logits = self._unroll(self.latents)[:, :T]  # (Z, T, K)
        every, chosen = torch.arange(T), rules.clamp(min=0)
        if self.support is None:
            legal = self.grammar.legal[: len(self.grammar.nonterminals)]
            total = logits.unsqueeze(2).where(legal, -torch.inf).logsumexp(-1)  # (Z, T, V)
            logp = (logits - total[..., self.grammar.lhs])[:, every, chosen]  # (Z, N, T)
        else:
            allowed, row = self.support.rows, self.support.rows_of(derivation.frontier)
            total = logits.unsqueeze(2).where(allowed, -torch.inf).logsumexp(-1)  # (Z, T, U)
            logp = logits[:, every, chosen] - total[:, every, row]
            logp = logp.masked_fill(~allowed[row, chosen], -torch.inf)
        return logp.masked_fill(rules < 0, 0.0).sum(-1)

    def _unroll(self, latents: Tensor) -> Tensor:
        x = torch.relu(self.dense(latents)).unsqueeze(1).expand(-1, self.max_steps, -1)
        return self.out(self.cell(x)[0])

    def _steps(self, steps: int) -> int:
        if steps > self.max_steps:
            raise ProbsceneError(
                f"expected derivations of at most max_steps = {self.max_steps} rules, got {steps}; there are no "
                "logits beyond."
            )
        return steps
