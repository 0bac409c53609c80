"""Scenes that a reader is trained on: the prior's, and arrangements that it hardly makes.

A reader that has seen the prior alone reads a target's rows badly, as the prior draws no rows. So in half of the scenes
each site has one of three patterns, in the prior's own scale u: independent, nearly the same for all siblings, or
evenly spaced along the siblings. Half of the values of a pattern are draws of the prior all the same. Only these, and
those of sites without a pattern, may supervise a reader: of all others siblings tell. Patterns say nothing of any
target. Axis letters: N scenes, M nodes.
"""

from typing import Any

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor
from torch.nn.functional import pad

from probscene.grammar import Grammar

from .graph import SceneGraph
from .sites import U_EPS, site_name

SAME, SPACED = 0.3, 0.3  # shares of the arranged scenes' sites; the rest is independent
PRIOR_PROBABILITY = 0.5  # of a value of a pattern
JITTER = 0.08  # largest spread of u around a pattern


class LayoutAugmentation(Messenger):
    """Inside it some of a program's scenes are arranged.

    Args:
        grammar: the model's.
        names: of the sites of nodes that are.
        share: of the scenes.

    Attributes:
        from_prior: ``(N, M)`` bool by site, which values are draws of the prior.
    """

    def __init__(self, grammar: Grammar, names: frozenset[str], share: float = 0.5):
        super().__init__()
        self.grammar, self.names, self.share = grammar, names, share
        self.graph: SceneGraph | None = None
        self.chosen = torch.zeros(0, dtype=torch.bool)
        self.from_prior: dict[str, Tensor] = {}

    def _pyro_post_derive(self, msg: Any) -> None:
        self.graph = SceneGraph.from_nodes(msg["value"].kind, msg["value"].parent)
        self.chosen = torch.rand(len(self.graph.kind)) < self.share

    def _pyro_sample(self, msg: Any) -> None:
        name = site_name(self.grammar, msg["name"])
        if self.graph is None or msg["value"] is not None or name not in self.names:
            return
        fn = msg["fn"]
        drawn = fn.sample()
        N, M = drawn.shape
        pattern, has_pattern = self._pattern(N, M)
        arranged = (self.chosen[:, None] & has_pattern) & (torch.rand(N, M) >= PRIOR_PROBABILITY)
        msg["value"] = torch.where(arranged, fn.icdf(pattern.clamp(U_EPS, 1 - U_EPS)), drawn)
        of_prior = ~arranged & (True if msg["mask"] is None else msg["mask"])
        before = self.from_prior.get(name, of_prior[:, :0])  # of another scenario
        width = max(M, before.shape[1])
        self.from_prior[name] = pad(of_prior, (0, width - M)) | pad(before, (0, width - before.shape[1]))

    def _pattern(self, N: int, M: int) -> tuple[Tensor, Tensor]:
        """``(N, M)`` u of each scene's own pattern, and which scenes ``(N, 1)`` have one."""
        graph = self.graph
        assert graph is not None
        shared = torch.rand(N, M + 1).gather(1, graph.parent + 1)
        low, high = torch.rand(2, N, 1).sort(0).values
        part = (graph.rank + 0.5) / graph.number.clamp(min=1)
        spaced = low + (high - low) * torch.where(torch.rand(N, 1) < 0.5, part, 1 - part)
        jitter = JITTER * torch.rand(N, 1) * torch.randn(N, M)
        which = torch.rand(N, 1)
        pattern = torch.where(which < SAME, shared, spaced) + jitter
        return _folded(pattern), which < SAME + SPACED


def _folded(u: Tensor) -> Tensor:
    """Reflected at 0 and 1 into what lies between."""
    return 1 - (u.remainder(2.0) - 1).abs()
