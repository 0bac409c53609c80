"""How long and how parameters are learnt."""

from dataclasses import dataclass

READING, SCENES, LIKELIHOOD = "reading", "scenes", "likelihood"
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
        recalibration_renders: by which readings are recalibrated before each training of a guide. By 400, the slope of
            a site that is read badly is off by a tenth, and a spread that is learnt by as much.
        images: of the target, at most, that are read.
        reader_images: renders a step of the reader; of large images fewer, but at least 4.
        reader_rate, scene_rate, rate, round_rate: largest learning rates, the last of maximum likelihood in rounds:
            noise of the weights widens narrow dependences.
    """

    reader_steps: int = 600
    scene_renders: int = 4096
    steps: int = 1000
    step_images: int = 200
    rounds: int = 2
    round_reader_steps: int = 250
    round_scene_renders: int = 1536
    round_steps: int = 300
    recalibration_renders: int = 2000
    images: int = 1000
    reader_images: int = 12
    reader_rate: float = 4e-3
    scene_rate: float = 2e-3
    rate: float = 5e-3
    round_rate: float = 1e-3

    @property
    def drawn(self) -> int:
        """About how many renders are drawn in all."""
        steps = self.reader_steps + self.rounds * self.round_reader_steps
        of_scenes = self.scene_renders + self.rounds * self.round_scene_renders
        return steps * self.reader_images + of_scenes + (1 + self.rounds) * self.recalibration_renders

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
        phases = [*first, *later * self.rounds]
        return [(what, steps) for what, steps in phases if steps and (of_scenes or what != SCENES)]
