"""The presets by name."""

from dataclasses import replace

from probscene.errors import ProbsceneError
from probscene.inference.divergence import JensenShannon, KDELogRatio
from probscene.inference.features.counting.batches import CountSchedule
from probscene.inference.features.counting.training import CountFeatures
from probscene.inference.features.presence import PresenceFeatures
from probscene.inference.features.projection import ProjectedFeatures
from probscene.inference.parameters.schedule import ParameterSchedule

from .config import Auto, FitConfig, LSTMConfig, Pretrain, ScoreFunctionTraining

QUICK = FitConfig(parameters=ParameterSchedule(step_images=80, rounds=3))
DEFAULT = replace(
    QUICK,
    features=Auto(CountFeatures(CountSchedule(steps=12000))),
    structure=ScoreFunctionTraining(batches=120),
    parameters=ParameterSchedule(step_images=80, rounds=3, reader_steps=800, round_steps=500),
)
# Streets have ten counts, some of which spread over tens, and a network is farther off the more there is: in counts, a
# kernel of one width is too wide for a pedestrian or too narrow for a wood.
# Objects behind others are counted as far as they can be seen at all; the prior holds what cannot. Images are so wide
# that a step has four of them, objects as large as what a network for digits sees at once, and most are trees and cars.
STREET = FitConfig(
    features=Auto(
        CountFeatures(
            CountSchedule(
                steps=7200,
                beyond_prior=True,
                crops=48,
                crop=64,
                balanced=True,
                relative=True,
                learning_rate=3e-3,
                muon_rate=0.02,
                min_visible=0.05,
                rounding=False,
            ),
            blocks=(1, 3),
        )
    ),
    divergence=JensenShannon(anscombe=True),
    structure=ScoreFunctionTraining(prior_kl_weight=0.03, draws_per_structure=1),
    parameters=ParameterSchedule(scene_renders=12288, round_scene_renders=4096),
)
# The paper's Multi-MNIST (section 4.1, supplement): 20 epochs of 5,000 target images in batches of 500 are 200 updates.
PAPER = FitConfig(
    features=PresenceFeatures(),
    divergence=KDELogRatio(variance=None, marginal_variance=None, leave_one_out=False),
    guide=LSTMConfig(index=False),
    pretrain=Pretrain(on_prior=True),
    structure=ScoreFunctionTraining(
        batches=200,
        num_real=500,
        draws_per_structure=1,
        updates=1,
        learning_rate=1e-4,
        cosine=False,
        baseline="moving_average",
        scale=1e-2,
        incompletion_weight=0.0,
    ),
    parameters=None,
)
PAPER_AERIAL = replace(PAPER, features=PresenceFeatures(counts=True))
# Five epochs of KITTI's 7,481 images in batches of 300; 2,000 structures of each of three scenarios.
PAPER_DRIVING = replace(
    PAPER,
    features=ProjectedFeatures("inception", directions=0),
    pretrain=Pretrain(derivations=6000, on_prior=True),
    structure=replace(PAPER.structure, batches=125, num_scenes=300, num_real=300),
)
PRESETS = {
    "quick": QUICK,
    "default": DEFAULT,
    "street": STREET,
    "paper": PAPER,
    "paper-aerial": PAPER_AERIAL,
    "paper-driving": PAPER_DRIVING,
}


def preset(name: str) -> FitConfig:
    """The preset of a name.

    Raises:
        ProbsceneError: there is none.
    """
    if name not in PRESETS:
        raise ProbsceneError(f"expected a preset among {', '.join(PRESETS)}, got {name!r}.")
    return PRESETS[name]


def images_drawn() -> dict[str, int]:
    """About how many images a fit has drawn, by preset."""
    on_photographs = {"quick with count=efficientnet": QUICK.for_photographs()}
    return {name: preset.images for name, preset in (PRESETS | on_photographs).items()}
