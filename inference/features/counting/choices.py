"""The choice of features that count by a network of the fit's own."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from probscene.model import SceneModel
from probscene.sampling import seed_everything

from ...training import batch_seed
from ..base import Features, Photographs, Renders
from .batches import CountSchedule
from .net import CountNet
from .training import CountTraining


@dataclass(frozen=True)
class CountFeatures(Features):
    """``CountNet``, trained on renders of the prior, or of what guides are pretrained on.

    Args:
        schedule: of its training.
        width, blocks: its size, see ``CountNet``.
    """

    schedule: CountSchedule = field(default_factory=CountSchedule)
    width: tuple[int, int, int] = (16, 32, 64)
    blocks: tuple[int, int] = (1, 1)

    name = "count"
    resolution = 0.5  # of a count

    @property
    def images(self) -> int:
        """See ``Features``; fewer of a canvas above 128 x 128 pixels."""
        return self.schedule.steps * self.schedule.images

    def build(self, model: SceneModel) -> CountNet:
        """Untrained."""
        rounding = self.schedule.rounding
        return CountNet(model.classes, model.channels, model.canvas, self.width, self.blocks, model.groups, rounding)

    def training(
        self, net: CountNet, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> CountTraining:
        """On renders alone, reduced no more than the model's small objects bear."""
        seed_everything(0)  # how large objects are is the model's, and the same for all seeds
        net.fit_to(renders.object_size())
        draw = partial(renders.draw, beyond_prior=self.schedule.beyond_prior)
        return CountTraining(net, draw, self.schedule, seed=batch_seed(seed, 1))
