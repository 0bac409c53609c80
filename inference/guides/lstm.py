"""The guide: an autoregressive LSTM over rules (Meta-Sim2, section 3.2 and supplement).

At each step it reads the previous rule through a linear embedding and gives logits over all rules. With ``index=True``
it also reads its list index and its parent list index (``Frontier``), embedded in the input and as additive
tables of logits. Without them an LSTM of 50 units has to learn to count, which takes much longer.

``|Z|`` fixed latent vectors set the first state; ``log_prob`` is the exact marginal over them,
``q(T) = 1/|Z| sum_z q(T|z)`` (section 3.3).
"""

from typing import Any, cast

import torch
from torch import Tensor, nn

from probscene.derivation import Derivation, Frontier
from probscene.errors import ProbsceneError
from probscene.grammar import Grammar

from .base import Guide, LatentGuide
from .grammar_vae import GrammarVAE
from .pcfg import PCFG

GUIDES = ("lstm", "pcfg", "grammar-vae")


class LSTMGuide(LatentGuide):
    """Also a Pyro program: ``guide(num_scenes)`` derives scenes inside the plate ``"scenes"``.

    Args:
        grammar: the grammar.
        max_steps: T_max.
        hidden: units of the LSTM; 50 in the paper.
        num_latents: ``|Z|``; 1 in the paper.
        latent_size: length of a latent vector.
        index: whether to read the list indices; not in the paper.
        max_index: indices from here on share one embedding.
    """

    def __init__(
        self,
        grammar: Grammar,
        max_steps: int,
        hidden: int = 50,
        num_latents: int = 1,
        latent_size: int = 16,
        index: bool = True,
        max_index: int = 32,
    ):
        super().__init__(grammar, max_steps)
        self.hidden, self.max_index = hidden, max_index
        K = len(grammar.rules)
        self.embed = nn.Embedding(K + 1, hidden)  # a linear layer on the one-hot of the previous rule, or of the start
        self.cell = nn.LSTM(hidden, hidden, batch_first=True)
        self.out = nn.Linear(hidden, K)
        self.register_buffer("latents", torch.randn(num_latents, latent_size))
        self.first_state = nn.Linear(latent_size, 2 * hidden)
        self.embed_index = self.index_logits = None
        if index:
            self.embed_index = nn.ModuleList(nn.Embedding(max_index + 1, hidden) for _ in range(2))
            self.index_logits = nn.ModuleList(nn.Embedding(max_index + 1, K) for _ in range(2))
            for table in (*self.embed_index, *self.index_logits):
                nn.init.zeros_(cast(nn.Embedding, table).weight)

    def start(self, num_scenes: int) -> tuple[Tensor, Tensor]:
        """First hidden and cell state, ``(N, hidden)`` each."""
        return self._state(self.latents[self.draw_latents(num_scenes)])

    def step(self, memory, frontier: Frontier, previous_rule: Tensor):
        """One step of the cell."""
        x = self._input(frontier, previous_rule)
        w: Any = self.cell  # torch names its weights as it makes them
        h, c = torch.lstm_cell(x, memory, w.weight_ih_l0, w.weight_hh_l0, w.bias_ih_l0, w.bias_hh_l0)
        return self._output(h, frontier), (h, c)

    def logits(self, derivation: Derivation, latent: int = 0) -> Tensor:
        """``(N, T, K)`` given latent vector number ``latent``, in one pass of the LSTM."""
        h, c = self._state(self.latents[latent : latent + 1])
        h, c = (s.expand(len(derivation), -1).unsqueeze(0).contiguous() for s in (h, c))
        states, _ = self.cell(self._input(derivation.frontier, derivation.previous_rules), (h, c))
        return self._output(states, derivation.frontier)

    def _state(self, latents: Tensor) -> tuple[Tensor, Tensor]:
        h, c = torch.tanh(self.first_state(latents)).chunk(2, -1)
        return h, c

    def _input(self, frontier: Frontier, previous_rule: Tensor) -> Tensor:
        x = self.embed(previous_rule + 1)
        return x if self.embed_index is None else x + self._indexed(self.embed_index, frontier)

    def _output(self, h: Tensor, frontier: Frontier) -> Tensor:
        logits = self.out(h)
        return logits if self.index_logits is None else logits + self._indexed(self.index_logits, frontier)

    def _indexed(self, tables: nn.ModuleList, frontier: Frontier) -> Tensor:
        index, parent_index = (i.clamp(max=self.max_index) for i in (frontier.list_index, frontier.parent_list_index))
        return tables[0](index) + tables[1](parent_index)


def make_guide(kind: str, grammar: Grammar, max_steps: int, **settings) -> Guide:
    """An untrained guide.

    Args:
        kind: ``"lstm"``, ``"pcfg"`` (one weight a rule) or ``"grammar-vae"`` (logits from z alone).
        settings: arguments of ``LSTMGuide``, ``PCFG`` or ``GrammarVAE``.

    Raises:
        ProbsceneError: another kind.
    """
    if kind not in GUIDES:
        raise ProbsceneError(f"expected a guide among {', '.join(GUIDES)}, got {kind!r}.")
    made = {"lstm": LSTMGuide, "pcfg": PCFG, "grammar-vae": GrammarVAE}[kind]
    return made(grammar, max_steps, **settings)
