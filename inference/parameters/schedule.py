"""How long and how parameters are learnt."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ParameterSchedule:
    """The defaults were chosen on Multi-MNIST.

    Args:
        reader_steps: of the reader's first training, on renders of the prior.
        scene_renders: from which sites of scenes are learnt to be read then; for models that have such sites.
        steps: of maximum likelihood on what is read first.
        rounds: of training the reader further on the guide's own renders, reading again and learning again.
        round_reader_steps, round_scene_renders, round_steps: of each.
        energy_steps, energy_scenes: of the energy distance at the end, and renders a step.
        images: of the target, at most, that are read.
        reader_images: renders a step of the reader; of large images fewer, but at least 4.
        reader_rate, scene_rate, rate, energy_rate: largest learning rates.
        sure: keep only sites whose readings come surely nearer to held-out images', even where whole images come nearer
            with all: for models with many sites, of which most are right. A spacing alone hardly makes them so.
    """

    reader_steps: int = 600
    scene_renders: int = 4096
    steps: int = 500
    rounds: int = 2
    round_reader_steps: int = 250
    round_scene_renders: int = 1536
    round_steps: int = 300
    energy_steps: int = 40
    energy_scenes: int = 100
    images: int = 1000
    reader_images: int = 12
    reader_rate: float = 4e-3
    scene_rate: float = 2e-3
    rate: float = 5e-3
    energy_rate: float = 2e-3
    sure: bool = False

    @property
    def drawn(self) -> int:
        """About how many renders are drawn in all."""
        steps = self.reader_steps + self.rounds * self.round_reader_steps
        of_scenes = self.scene_renders + self.rounds * self.round_scene_renders
        return steps * self.reader_images + of_scenes + self.energy_steps * self.energy_scenes
