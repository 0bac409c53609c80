"""Scenes that a reader is trained on: the prior's, and arrangements that it hardly makes.

A reader that has seen the prior alone reads a target's rows badly, as the prior draws no rows. So in half of the scenes
each site has one of three patterns, in the prior's own scale u: independent, nearly the same for all siblings, or
evenly spaced along the siblings. They say nothing of any target. Axis letters: N scenes, M nodes.
"""

from typing import Any

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from probscene.grammar import Grammar

from .graph import SceneGraph
from .sites import U_EPS, site_name

SAME, SPACED = 0.3, 0.3  # shares of the arranged scenes' sites; the rest is independent
JITTER = 0.08  # largest spread of u around a pattern


class LayoutAugmentation(Messenger):
    """Inside it some of a program's scenes are arranged.

    Args:
        grammar: the model's.
        names: of the sites of nodes that are.
        share: of the scenes.
    """

    def __init__(self, grammar: Grammar, names: frozenset[str], share: float = 0.5):
        super().__init__()
        self.grammar, self.names, self.share = grammar, names, share
        self.graph: SceneGraph | None = None
        self.chosen = torch.zeros(0, dtype=torch.bool)

    def _pyro_post_derive(self, msg: Any) -> None:
        self.graph = SceneGraph.from_nodes(msg["value"].kind, msg["value"].parent)
        self.chosen = torch.rand(len(self.graph.kind)) < self.share

    def _pyro_sample(self, msg: Any) -> None:
        if self.graph is None or msg["value"] is not None or site_name(self.grammar, msg["name"]) not in self.names:
            return
        fn = msg["fn"]
        drawn = fn.sample()
        u = self._pattern(fn.cdf(drawn)).clamp(U_EPS, 1 - U_EPS)
        msg["value"] = torch.where(self.chosen[:, None], fn.icdf(u), drawn)

    def _pattern(self, u: Tensor) -> Tensor:
        """``(N, M)``: each scene's own pattern."""
        graph = self.graph
        assert graph is not None
        N, M = u.shape
        shared = torch.rand(N, M + 1).gather(1, graph.parent + 1)
        low, high = torch.rand(2, N, 1).sort(0).values
        part = (graph.rank + 0.5) / graph.number.clamp(min=1)
        spaced = low + (high - low) * torch.where(torch.rand(N, 1) < 0.5, part, 1 - part)
        jitter = JITTER * torch.rand(N, 1) * torch.randn(N, M)
        which = torch.rand(N, 1)
        pattern = torch.where(which < SAME, shared, spaced) + jitter
        return torch.where(which < SAME + SPACED, _folded(pattern), u)


def _folded(u: Tensor) -> Tensor:
    """Reflected at 0 and 1 into what lies between."""
    return 1 - (u.remainder(2.0) - 1).abs()
