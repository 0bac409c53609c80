"""The choices of features that count: by a network of the fit's own, or by heads on a pretrained network's maps."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

from probscene.model import SceneModel
from probscene.sampling import seed_everything

from ...divergence import Blockwise, Divergence
from ...training import Training, batch_seed
from ..base import FeatureNet, Features, Photographs, Renders
from .batches import CountSchedule
from .net import CountNet
from .training import CountTraining

if TYPE_CHECKING:
    from .pretrained import PretrainedCountNet

COUNT_ON_PRETRAINED = "count=efficientnet"


@dataclass(frozen=True)
class CountFeatures(Features):
    """``CountNet``, trained on the prior's renders.

    Args:
        schedule: of its training.
        width, blocks: its size, see ``CountNet``.
    """

    schedule: CountSchedule = field(default_factory=CountSchedule)
    width: tuple[int, int, int] = (16, 32, 64)
    blocks: tuple[int, int] = (1, 1)

    name = "count"
    resolution = 0.5  # of a count

    def build(self, model: SceneModel) -> CountNet:
        """Untrained."""
        return CountNet(model.classes, model.channels, model.canvas, self.width, self.blocks, model.groups)

    def training(
        self, net: CountNet, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> CountTraining:
        """On renders alone, reduced no more than the model's small objects bear."""
        seed_everything(batch_seed(seed, 4))
        net.fit_to(renders.object_size())
        return CountTraining(net, renders.draw, self.schedule, seed=batch_seed(seed, 1))


@dataclass(frozen=True)
class PretrainedCountFeatures(Features):
    """``PretrainedCountNet``: heads trained on renders, then on what they believe of the target's own images.

    Args:
        pairs: structures that are drawn twice.
        epochs: on renders.
        photographs: images of the target, at most, on which the heads teach themselves in one more epoch; 0 for none.
        directions: of the projection that stands beside the counts.
        scenes: in a batch of the fit, for which the unit of the counts is chosen.
    """

    pairs: int = 1000
    epochs: int = 8
    photographs: int = 500
    directions: int = 8
    scenes: int = 150

    name = COUNT_ON_PRETRAINED
    pretrained = True

    def build(self, model: SceneModel) -> FeatureNet:
        """Pretrained, with untrained heads."""
        from .pretrained import PretrainedCountNet  # torchvision takes seconds to import

        return PretrainedCountNet(model.classes, self.directions, model.canvas, model.stuff)

    def training(
        self, net: FeatureNet, renders: Renders, photographs: Callable[[], Photographs], seed: int
    ) -> Training:
        """On renders of what guides are pretrained on: of the prior's few cars a head would learn that there are few,
        and in photographs it must read many."""
        from .pretrained_training import PretrainedCountTraining

        some, heads = None, cast("PretrainedCountNet", net)
        if self.photographs:
            some = photographs().some(self.photographs)
            heads.learn_from(photographs().fingerprint)
        seed = batch_seed(seed, 1)
        return PretrainedCountTraining(
            heads, renders.draw_twice, self.pairs, self.epochs, self.scenes, seed=seed, photographs=some
        )

    def divergence(self, net: FeatureNet, chosen: Divergence) -> Divergence:
        """Of things as chosen, of stuff none, of directions without marginals: photographs often lie beyond all renders
        in one, where what is nearest is not what has as many cars."""
        joint = replace(cast(Any, chosen), marginal_variance=None) if hasattr(chosen, "marginal_variance") else chosen
        return Blockwise(cast("PretrainedCountNet", net).blocks, (chosen, None, joint))

    def taught_by(self, net: FeatureNet) -> str:
        """The images that the heads taught themselves on."""
        return cast("PretrainedCountNet", net).taught_by_fingerprint

    def settings(self, preset: Any) -> dict[str, Any]:
        """Photographs' counts are noisy, and few: a prior, where there is one, holds them more. Those of things do lie
        among the renders', and a bounded objective bears their marginals. After 40 batches costs still fall."""
        weight = max(preset.prior_kl_weight, 0.1) if preset.prior_kl_weight else 0.0
        single = 0.25 if preset.objective == "js" else None
        few = {"marginal_variance": single, "pairs": 1000, "prior_kl_weight": weight, "batches": 60}
        return slow_settings(preset) | few


def slow_settings(preset: Any) -> dict[str, Any]:
    """What suits a network that takes about 20 ms an image on one core where a preset's own takes 1: fewer scenes, each
    drawn once, and at so noisy a gradient half the step. Marginals, far sharper than the joint density, say of
    photographs only that they are none. Features come in units of their bandwidth, which the kernel takes."""
    return {
        "batches": 40,
        "num_scenes": 150,
        "draws_per_structure": 1,
        "learning_rate": min(preset.learning_rate, 5e-3),
        "marginal_variance": None,
        "variance": None if preset.variance is None else 1.0,
    }
