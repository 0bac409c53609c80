"""How long tilting learns."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TiltingSchedule:
    """The defaults were chosen on blood smears and KITTI's frames.

    Args:
        rounds: of drawing, tilting and fitting.
        first: scenes of the first round, in which it is seen which sites tell; each is rendered.
        scenes: of each other round.
        ess_fraction: effective share of a round's scenes that is left when they are weighted, 0 to 1; more where what
            is explained of them could be chance.
        steps: of maximum likelihood on them.
        rate: its largest learning rate.
        images: of the target, at most.
        feature_size: of the square whose area images enter EfficientNet with, pixels; time grows with its area.
    """

    rounds: int = 10
    first: int = 2000
    scenes: int = 400
    ess_fraction: float = 0.4
    steps: int = 60
    rate: float = 5e-3
    images: int = 1000
    feature_size: int = 224

    @property
    def drawn(self) -> int:
        """How many renders are drawn in all."""
        return self.first + (self.rounds - 1) * self.scenes
