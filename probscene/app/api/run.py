"""A fit as a Python object."""

import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probscene.batch import RenderBatch
from probscene.inference.divergence import Divergence
from probscene.inference.features.base import FeatureNet, Features
from probscene.model import SceneModel
from probscene.sampling import Scenes, sample

from ..arguments import checked_seed, positive
from ..chunks import chunk_randomness
from ..datasets.generate import Dataset, DatasetOptions
from ..evaluation.evaluate import Evaluation
from ..evaluation.labels import Labels, TargetLabels
from ..files import make_folder
from ..fitting.plugins import GuideMaker, Plugins, as_divergence, as_features, as_guide_maker
from ..fitting.run import RunFolder
from ..fitting.store import check_free
from ..targets import Target, TargetImages
from . import calls

if TYPE_CHECKING:
    from ..detectors.source_comparison import SourceComparison


class Run(RunFolder):
    """A fit: what was learnt, and what can be done with it. ``probscene.fit`` and ``Run.open`` give one.

    Attributes:
        path: its folder; a temporary one, which goes with the object, where the fit was given none.
        record: the contents of its ``run.json``.
        model: the scene model.
        guide: what was learnt, a policy and a Pyro program.
    """

    @classmethod
    def open(
        cls,
        path: Path | str,
        model: SceneModel | None = None,
        features: Features | FeatureNet | None = None,
        divergence: Divergence | None = None,
        guide: GuideMaker | None = None,
    ) -> "Run":
        """A run that was saved.

        Args:
            model, features, divergence, guide: what the run was begun with, where that were objects in memory.

        Raises:
            RunError: there is none, it is damaged, or another version wrote it; its model or its guide were in memory
                and are not given. Features and a divergence are asked for where they are used.
        """
        run = cls.at(
            Path(path),
            model,
            Plugins(
                None if features is None else as_features(features),
                None if divergence is None else as_divergence(divergence),
                None if guide is None else as_guide_maker(guide),
            ),
        )
        run.check_objects("model", "guide")
        return run

    def sample(self, num: int, seed: int = 0) -> Scenes:
        """Scenes with learnt structures; the same for the same seed."""
        guide = self.guide  # is made with random numbers of its own
        with chunk_randomness(checked_seed(seed), 0):
            return sample(self.model, guide, positive(num, "scenes"))

    def render(self, num: int, seed: int = 0) -> RenderBatch:
        """``sample``, rendered and labelled."""
        return calls.render(self.model, self.sample(num, seed))

    def generate(
        self,
        num: int,
        out: Path | str,
        format: str | Iterable[str] = "coco",
        options: DatasetOptions | None = None,
        *,
        seed: int = 0,
        workers: int | str = 1,
        progress: bool = True,
    ) -> Dataset:
        """Write a labelled dataset of the learnt structures, see ``generate``."""
        return calls.generate(self, num, out, format, options, seed=seed, workers=workers, progress=progress)

    def evaluate(
        self,
        target: TargetImages | Target = None,
        labels: TargetLabels | Path | str | Labels | None = None,
        **options: Any,
    ) -> Evaluation:
        """Compare what was learnt with the target, see ``evaluate``."""
        return calls.evaluate(self, target, labels, **options)

    def compare_sources(self, *, progress: bool = True) -> "SourceComparison | None":
        """Compare what a detector learns from the prior and from the fit, see ``compare_sources``."""
        return calls.compare_sources(self, progress=progress)

    def report(self, out: Path | str | None = None, **options: Any) -> Path:
        """Write an HTML page about the run, see ``report``."""
        return calls.report(self, out, **options)

    def save(self, path: Path | str) -> "Run":
        """Copy the run to a folder of its own, and open it there.

        Raises:
            RunError: the folder holds a run or other files already.
            MachineError: it cannot be written.
        """
        path = Path(path)
        check_free(path)
        make_folder(path.parent)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as aside:
            shutil.copytree(self.path, Path(aside) / "run")
            if path.is_dir():
                shutil.copytree(Path(aside) / "run", path, dirs_exist_ok=True)
            else:
                (Path(aside) / "run").rename(path)
        return type(self)(path, self.record, self._model, self.plugins)
