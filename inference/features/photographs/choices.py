"""The choice of features that count in photographs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from probscene.model import SceneModel

from ...divergence import Blockwise, Divergence
from ...training import Training, batch_seed
from ..base import FeatureNet, Features, ImageCallback, Photographs, Renders

if TYPE_CHECKING:
    from .net import PretrainedCountNet

COUNT_ON_PRETRAINED = "count=efficientnet"


@dataclass(frozen=True)
class PretrainedCountFeatures(Features):
    """``PretrainedCountNet``: heads trained on renders; how they are read in photographs is chosen by the photographs,
    and by a few labels where there are such.

    Args:
        pairs: structures that are drawn twice.
        epochs: of the heads.
        photographs: images of the target, at most, from which heads learn and by which rules are chosen.
        scenes: in a batch of the fit, for which the unit of the counts is chosen.
    """

    pairs: int = 1000
    epochs: int = 8
    photographs: int = 500
    scenes: int = 150

    name = COUNT_ON_PRETRAINED
    pretrained = True
    takes_labels = True
    resolution = 0.5  # of a count: renders' are whole numbers, photographs' are not

    @property
    def images(self) -> int:
        """See ``Features``."""
        return 2 * self.pairs

    def build(self, model: SceneModel) -> FeatureNet:
        """Pretrained, with untrained heads."""
        from .net import PretrainedCountNet  # torchvision takes seconds to import

        return PretrainedCountNet(model.classes, model.canvas, model.stuff, self.scenes)

    def training(
        self, net: FeatureNet, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> Training:
        """On renders of what guides are pretrained on: of the prior's few cars a head would learn that there are few,
        and in photographs it must read many. Then on the photographs."""
        from .training import PretrainedCountTraining

        heads, target = cast("PretrainedCountNet", net), photographs()
        heads.bind(target.fingerprint)
        draw, images = renders.draw_twice, target.subset(self.photographs)
        return PretrainedCountTraining(
            heads, draw, self.pairs, self.epochs, photographs=images, seed=batch_seed(seed, 1)
        )

    def adapt(self, net: FeatureNet, photographs: Callable[[], Photographs], callback: ImageCallback) -> dict[str, Any]:
        """Choose how each class is read."""
        from .adapting import adapt

        return adapt(cast("PretrainedCountNet", net), photographs(), self.photographs, callback)

    def divergence(self, net: FeatureNet, chosen: Divergence) -> Divergence:
        """Of things as chosen, of stuff none."""
        return Blockwise(cast("PretrainedCountNet", net).blocks, (chosen, None))

    def target_fingerprint(self, net: FeatureNet) -> str:
        """The images that heads and rules are suited to."""
        return cast("PretrainedCountNet", net).taught_by_fingerprint

    def settings(self, config: Any) -> dict[str, Any]:
        """Renders need not be read, so that batches may be large; what is hidden in a drawing does not count, so that
        each structure is drawn once. Numbers that no photograph shows cost so much at first that a guide is thrown too
        far, from where 40 or 80 batches may not bring it back. Photographs' counts are noisy, and few: the prior of a
        preset that has such a weight holds them more. They come in units of their bandwidth, which the kernel takes as
        they are. Parameters are not learnt by what a reader reads in photographs, of which it has seen none."""
        weight = config.structure.prior_kl_weight
        return {
            "parameters": "tilting",
            "structure.batches": 120,
            "structure.num_scenes": 250,
            "structure.draws_per_structure": 1,
            "structure.prior_kl_weight": max(weight, 0.1) if weight else 0.0,
            "divergence.variance": None if getattr(config.divergence, "variance", 1.0) is None else 1.0,
            "divergence.marginal_variance": 0.1,
            "divergence.anscombe": False,
        }
