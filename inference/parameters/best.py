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
