"""How long and how parameters are learnt."""

from dataclasses import dataclass

READING, SCENES, LIKELIHOOD, ENERGY = "reading", "scenes", "likelihood", "energy"
REFIT, WEIGHTS = "refit", "weights"
OF_SCENES, OF_GUIDE = (SCENES, REFIT, WEIGHTS), (LIKELIHOOD, ENERGY)
RENDERS_PER_STEP = 2  # of the training of a head for sites of scenes


@dataclass(frozen=True)
class ParameterSchedule:
    """The defaults were chosen on Multi-MNIST.

    Args:
        reader_steps: of the reader's first training, on renders of the prior.
        scene_renders: from which sites of scenes are learnt to be read then; for models that have such sites.
        steps: of maximum likelihood on what is read first.
        step_images: of the target that each step of it looks at, at most.
        rounds: of training the reader further on the guide's own renders, reading again and learning again.
        round_reader_steps, round_scene_renders, round_steps: of each.
        energy_steps, energy_scenes: of the energy distance then, and renders a step.
        weighted_scenes: renders that are weighted at the end, where sites of scenes are read with little skill; these
            are read anew, from ``scene_renders`` more, and weights take ``round_steps``.
        images: of the target, at most, that are read.
        reader_images: renders a step of the reader; of large images fewer, but at least 4.
        reader_rate, scene_rate, rate, energy_rate: largest learning rates.
        sure: keep only sites whose readings come surely nearer to held-out images', even where whole images come nearer
            with all: for models with many sites, of which most are right. A spacing alone hardly makes them so.
    """

    reader_steps: int = 600
    scene_renders: int = 4096
    steps: int = 500
    step_images: int = 200
    rounds: int = 2
    round_reader_steps: int = 250
    round_scene_renders: int = 1536
    round_steps: int = 300
    energy_steps: int = 40
    energy_scenes: int = 100
    weighted_scenes: int = 3000
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
        of_scenes = 2 * self.scene_renders + self.rounds * self.round_scene_renders + self.weighted_scenes
        return steps * self.reader_images + of_scenes + self.energy_steps * self.energy_scenes

    def phases(self, of_scenes: bool) -> list[tuple[str, int]]:
        """What is trained, one after the other, and for how many steps.

        Args:
            of_scenes: whether the model has sites of scenes.
        """
        scene_steps, round_scene_steps = (
            renders // RENDERS_PER_STEP for renders in (self.scene_renders, self.round_scene_renders)
        )
        first = [(READING, self.reader_steps), (SCENES, scene_steps), (LIKELIHOOD, self.steps)]
        later = [(READING, self.round_reader_steps), (SCENES, round_scene_steps), (LIKELIHOOD, self.round_steps)]
        last = [(REFIT, scene_steps), (WEIGHTS, self.round_steps)] if self.weighted_scenes else []
        phases = [*first, *later * self.rounds, (ENERGY, self.energy_steps), *last]
        return [(what, steps) for what, steps in phases if steps and (of_scenes or what not in OF_SCENES)]
