"""``probscene.fit``."""

import shutil
import tempfile
import weakref
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from probscene.dataset import Images
from probscene.device import chosen_device
from probscene.model import SceneModel

from ..arguments import checked_seed
from ..evaluation.diagnose import FitDiagnostics, diagnose
from ..evaluation.evaluate import warn_of_saturated_lists
from ..fitting import begin as beginning
from ..fitting.begin import FitRequest, ModelFile
from ..fitting.config import FitConfig
from ..fitting.pipeline import Begun, Execution, carry_out, open_target
from ..fitting.presets import preset
from ..progress import Display
from ..targets import Target, TargetImages
from ..workers.cluster import connected
from ..workers.processes import end_if_starting
from .calls import display
from .run import Run

DEFAULT = "default"


def fit(
    model: SceneModel | ModelFile | Path | str | None = None,
    target: TargetImages | Target = None,
    config: FitConfig | str | None = None,
    *,
    out: Path | str | None = None,
    seed: int | None = None,
    labels: Path | str | None = None,
    resume: bool = False,
    execution: Execution | None = None,
) -> Run:
    """Learn the structure, position and appearance of scenes from unlabelled images.

    Args:
        model: a scene model, the name of a built-in one, or a Python file; ``ModelFile`` for one that is drawn with a
            folder of assets.
        target: a folder of images, a list of files or of Pillow images, an array
            ``(L, H, W)`` or ``(L, H, W, 1 or 3)``, or a torch dataset of images, see ``ImageFolder`` and
            ``ImageArray``; ``TargetImages`` says how they are read, and what a detector of yours found in them.
        config: how to learn: a ``FitConfig``, or the name of a preset: ``"quick"``, ``"default"``, ``"street"``,
            ``"paper"``, ``"paper-aerial"`` or ``"paper-driving"``; ``"default"`` where None.
        out: the folder of the run; a temporary one where None, which ``Run.save`` copies.
        seed: of everything random; 0 where None.
        labels: of a few of the images, for features that take them: a ``counts.csv``, COCO's ``.json``, KITTI's folder
            ``label_2`` or YOLO's ``labels``.
        resume: go on with the run in ``out`` where there is one; arguments that are given have to be those that it was
            begun with. Model, target, labels and readings may lie elsewhere by now, if they are the same bytes.
        execution: threads, cluster, cache, progress and device.

    Raises:
        ProbsceneError: an input is at fault; the message says which and what to do. What was finished of the run stays,
            and ``resume=True`` goes on with it.
    """
    end_if_starting()
    execution = execution or Execution()
    request = fit_request(model, target, config, seed, labels, execution.threads)
    temporary, folder = None, None if out is None else Path(out)
    if folder is None:
        temporary = tempfile.mkdtemp(prefix="probscene-")
        folder = Path(temporary) / "run"
    resume = resume and (folder / "run.json").exists()
    if request.config is None and not resume:
        request = replace(request, config=preset(DEFAULT))
    with display(execution.progress) as show:
        try:
            run = carried_out(request, folder, show, resume, execution).run
        except BaseException:
            if temporary is not None:
                shutil.rmtree(temporary, ignore_errors=True)
            raise
    if temporary is not None:
        weakref.finalize(run, shutil.rmtree, temporary, True)
    return run


class FitAndDiagnostics(NamedTuple):
    """A run, and what can be said of it without labels; None where it was finished before."""

    run: Run
    diagnostics: FitDiagnostics | None


def fit_and_diagnose(
    request: FitRequest, out: Path, resume: bool, execution: Execution, verdict: bool, by_detectors: bool = False
) -> FitAndDiagnostics:
    """A fit and its verdict, as the command line gives them.

    Args:
        by_detectors: sources are compared first, see ``compare_and_keep``.

    Raises:
        ProbsceneError: see ``fit`` and ``diagnose``.
    """
    with display(execution.progress) as show:
        done = carried_out(request, out, show, resume, execution)
        found, images = None, done.images
        if by_detectors and not done.run.sources:
            from ..detectors.source_comparison import compare_and_keep  # torchvision takes seconds to import

            images = images or open_target(done.run, show)
            compare_and_keep(done.run, images, show, show.say, str(execution.device_for(done.run)))
        if verdict and done.unfinished:
            found = diagnose(done.run, images or open_target(done.run, show), show)
    return FitAndDiagnostics(done.run, found)


class Done(NamedTuple):
    """A finished fit.

    Attributes:
        run: its folder.
        images: of the target; None where they were not opened.
        unfinished: whether it was, before.
    """

    run: Run
    images: Images | None
    unfinished: bool


def carried_out(request: FitRequest, out: Path, show: Display, resume: bool, execution: Execution) -> Done:
    """Begin a run, or take one up again, and finish it.

    Raises:
        ProbsceneError: see ``fit``.
    """
    if execution.device is not None:
        chosen_device(execution.device)
    with connected(execution.cluster, show.say) as nodes:  # first, so that a wrong address leaves no run behind
        begun: Begun = (beginning.resume if resume else beginning.begin)(request, out, show, Run)
        run, unfinished = begun.run, not begun.run.is_finished
        assert isinstance(run, Run)
        if unfinished:
            carry_out(begun, show, execution.cache, nodes, execution.device_for(run))
    if unfinished:
        warn_of_saturated_lists(run, show)
    return Done(run, begun.images, unfinished)


def fit_request(
    model: SceneModel | ModelFile | Path | str | None,
    target: TargetImages | Target,
    config: FitConfig | str | None,
    seed: int | None,
    labels: Path | str | None,
    threads: int | None = None,
) -> FitRequest:
    """The arguments of ``fit`` as its stages take them.

    Raises:
        ProbsceneError: a seed or the name of a preset that is none.
    """
    if model is not None and not isinstance(model, SceneModel | ModelFile):
        model = ModelFile(str(model))
    if target is not None and not isinstance(target, TargetImages):
        target = TargetImages(target)
    return FitRequest(
        model,
        target,
        preset(config) if isinstance(config, str) else config,
        None if seed is None else checked_seed(seed),
        None if labels is None else Path(labels),
        threads,
    )
