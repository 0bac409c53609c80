"""One guide a scenario, learnt together (Meta-Sim2, supplement): densities are estimated over the scenes of all of
them, and each guide is scored on its own scenes."""

from collections.abc import Callable
from functools import partial
from typing import cast

from torch import Tensor, nn

from probscene.derivation import Derivation, Frontier
from probscene.grammar import Grammar
from probscene.scenarios import JointGrammar, Mixture
from probscene.support import Support

from .base import Guide
from .lstm import make_guide


class ScenarioGuide(Guide):
    """A guide of a joint grammar: a scenario by its fixed weight, then that scenario's own guide.

    Args:
        grammar: the joint grammar.
        max_steps: T_max of the joint model.
        weights: of the scenarios; equal if None, as in the paper.
        kind, settings: of each scenario's guide, see ``make_guide``.
        make: makes each scenario's guide instead, from its grammar and T_max.
    """

    grammar: JointGrammar

    def __init__(
        self,
        grammar: JointGrammar,
        max_steps: int,
        weights: list[float] | None = None,
        kind: str = "lstm",
        make: Callable[[Grammar, int], Guide] | None = None,
        **settings,
    ):
        super().__init__(grammar, max_steps)
        make = partial(make_guide, kind, **settings) if make is None else make
        guides = [make(part, max_steps - 1) for part in grammar.parts.values()]
        self.guides = nn.ModuleList(guides)
        self.mixture = Mixture(grammar, guides, weights)

    def bind(self, support: Support | None) -> None:
        """Bind it to the joint grammar's support, and each scenario's own guide to its part."""
        super().bind(support)
        grammar = self.grammar
        parts = zip(grammar.parts.values(), grammar.first_symbol, grammar.first_rule, strict=True)
        for guide, part in zip(self.guides, parts, strict=True):
            cast(Guide, guide).bind(None if support is None else support.part(*part))

    def start(self, num_scenes: int) -> list:
        """The memories of all guides."""
        return self.mixture.start(num_scenes)

    def step(self, memory: list, frontier: Frontier, previous_rule: Tensor) -> tuple[Tensor, list]:
        """Logits ``(N, K)``, see ``Mixture``."""
        return self.mixture.step(memory, frontier, previous_rule)

    def log_prob(self, derivation: Derivation) -> Tensor:
        """``log q(T)``, ``(N,)``, marginal over the latent vectors of the scenario's guide."""
        return self.mixture.log_prob(derivation)

    def strata(self, derivation: Derivation) -> Tensor:
        """``(N,)`` int64, whose guide's each scene is."""
        return self.grammar.scenario(derivation)


def guide_of(
    grammar: Grammar, max_steps: int, make: Callable[[Grammar, int], Guide] | None = None, **settings
) -> Guide:
    """An untrained guide of a grammar; of a joint one, a guide for each scenario.

    Args:
        max_steps: T_max.
        make: makes a guide from a grammar and T_max, instead of ``make_guide``.
        settings: of ``make_guide``.
    """
    if isinstance(grammar, JointGrammar):
        return ScenarioGuide(grammar, max_steps, make=make, **settings)
    return make_guide(grammar=grammar, max_steps=max_steps, **settings) if make is None else make(grammar, max_steps)
