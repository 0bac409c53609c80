"""How long Meta-Sim's way learns."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MetaSimSchedule:
    """A step renders ``scenes + 2 x values`` images.

    Args:
        steps: of Adam.
        scenes: a step.
        values: of these scenes' sites that are moved in a step, at most, chosen at random; None for all, see
            ``Differences``.
        rate: the largest learning rate.
        difference: by how much a value is moved to each side, in its prior's CDF.
        images: of the target, at most.
        feature_size: of the square whose area images enter the feature network with, pixels; time grows with its area.
        hidden: units of the network.
        rounds: of its message passing.
    """

    steps: int = 100
    scenes: int = 48
    values: int | None = 200
    rate: float = 1e-3
    difference: float = 0.03
    images: int = 1000
    feature_size: int = 160
    hidden: int = 64
    rounds: int = 3

    @property
    def drawn(self) -> int:
        """About how many renders are drawn in all."""
        return self.steps * (self.scenes + 2 * (self.values or self.scenes))
