"""The best state of a parameter guide so far, by images that nothing is learnt from."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..statistics.energy import Features, bootstrap_test
from ..training import of_prefix
from .guide import ParameterGuide


class HeldOutSet(NamedTuple):
    """Held-out images that guides are compared with.

    Attributes:
        look: gives features of a guide's renders, ``(N, D)``, under one seed.
        real: those of the images, ``(L, D)``.
    """

    look: Callable[[ParameterGuide], Features]
    real: Features

    def looks(self, guide: ParameterGuide, prior_sites: frozenset[str]) -> Features:
        """Those of a guide's renders in which sites of some names have their prior, ``(N, D)``."""
        guide.prior_sites = prior_sites
        looks = self.look(guide)
        guide.prior_sites = frozenset()
        return looks


class CheckpointSelector:
    """Goes back to the best state where training made a guide's scenes significantly farther from held-out images.

    Attributes:
        weights: of the best guide's network so far; empty before the first one.
        prior_sites: names of its sites that had their prior where it was judged.
    """

    def __init__(self, held: HeldOutSet):
        self.held, self.weights, self.prior_sites = held, dict[str, Tensor](), frozenset[str]()
        self.looks: Features | None = None

    def update(self, guide: ParameterGuide, prior_sites: frozenset[str] = frozenset()) -> None:
        """Compare a guide with the best so far, after a training of it; in place.

        Args:
            prior_sites: names of sites that have their prior in the renders that are compared, as they would keep it in
                the end: what was learnt of them must not decide about the others.
        """
        now = {key: value.clone() for key, value in guide.net.state_dict().items()}
        looks = self.held.looks(guide, prior_sites)
        if self.weights:
            guide.net.load_state_dict(self.weights)
            if self.looks is None:  # resumed
                self.looks = self.held.looks(guide, self.prior_sites)
            if bootstrap_test(looks, self.looks, self.held.real).significant:
                return
            guide.net.load_state_dict(now)
        self.weights, self.looks, self.prior_sites = now, looks, prior_sites

    def state(self) -> dict[str, Tensor]:
        """All that ``restore`` needs, as named tensors."""
        weights = {f"weights.{key}": value for key, value in self.weights.items()}
        return weights | {f"passed.{name}": torch.ones(()) for name in self.prior_sites}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from a ``state``."""
        self.weights, self.prior_sites = of_prefix(tensors, "weights."), frozenset(of_prefix(tensors, "passed."))


def uninformative_sites(guide: ParameterGuide, held: HeldOutSet) -> frozenset[str]:
    """Names of the sites whose learnt values do not surely bring renders nearer to the images, each tried alone.

    Those that do are tried together as well; where that is no nearer than the prior, all are named but the best one.
    """
    names = frozenset(site.name for site in guide.sites)

    def look(useful: frozenset[str]) -> Features:
        return held.looks(guide, names - useful)

    prior, away = look(frozenset()), {}
    for name in sorted(names):
        test = bootstrap_test(prior, look(frozenset((name,))), held.real)
        if test.significant:
            away[name] = test.baseline_distance
    if len(away) > 1:
        test = bootstrap_test(look(frozenset(away)), prior, held.real)
        if test.distance >= test.baseline_distance:
            away = {min(away, key=away.__getitem__): 0.0}
    return names - frozenset(away)
