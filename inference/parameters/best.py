"""The best state of a parameter guide so far, by images that nothing is learnt from."""

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from ..judging.farther import farther
from ..judging.two_sample import Features
from .guide import ParameterGuide


class HeldOut(NamedTuple):
    """What judges.

    Attributes:
        look: gives features of a guide's renders, ``(N, D)``, under one seed.
        real: those of the images, ``(L, D)``.
    """

    look: Callable[[ParameterGuide], Features]
    real: Features


class Best:
    """Goes back to the best state where training has made a guide's scenes surely farther from the images.

    Attributes:
        weights: of the best guide's network so far; empty before the first one.
    """

    def __init__(self, held: HeldOut):
        self.held, self.weights = held, dict[str, Tensor]()
        self.looks: Features | None = None

    def after(self, guide: ParameterGuide) -> None:
        """Judge a guide after a training of it; in place."""
        now = {key: value.clone() for key, value in guide.net.state_dict().items()}
        looks = self.held.look(guide)
        if self.weights:
            guide.net.load_state_dict(self.weights)
            if self.looks is None:  # resumed
                self.looks = self.held.look(guide)
            if farther(looks, self.looks, self.held.real).sure:
                return
            guide.net.load_state_dict(now)
        self.weights, self.looks = now, looks


def useless(guide: ParameterGuide, held: HeldOut) -> frozenset[str]:
    """Names of the sites whose learnt values do not surely bring renders nearer to the images, each tried alone.

    Those that do are tried together as well; where that is no nearer than the prior, all are named but the best one.
    """
    names = frozenset(site.name for site in guide.sites)

    def look(useful: frozenset[str]) -> Features:
        guide.passed = names - useful
        return held.look(guide)

    prior, away = look(frozenset()), {}
    for name in sorted(names):
        apart = farther(prior, look(frozenset((name,))), held.real)
        if apart.sure:
            away[name] = apart.other
    if len(away) > 1:
        apart = farther(look(frozenset(away)), prior, held.real)
        if apart.one >= apart.other:
            away = {min(away, key=away.__getitem__): 0.0}
    guide.passed = frozenset()
    return names - frozenset(away)
