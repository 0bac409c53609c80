"""What is done with a run or a model: images, datasets, evaluations, reports."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from probscene.batch import RenderBatch
from probscene.dataset import Images
from probscene.errors import ProbsceneError
from probscene.model import SceneModel
from probscene.sampling import Scenes

from ..datasets.generate import Dataset, DatasetOptions, generate_scenes, workers_or_cluster
from ..datasets.generate import generate as generate_run
from ..evaluation import compare as comparing
from ..evaluation import evaluate as evaluating
from ..evaluation.compare import Comparison
from ..evaluation.evaluate import Evaluation
from ..evaluation.labels import Labels, TargetLabels
from ..evaluation.visible import Visible
from ..fitting.pipeline import open_target
from ..fitting.run import RunFolder, is_run
from ..loading import load_model, renderer_for
from ..progress import Display
from ..targets import Target, TargetImages, open_images
from ..views import comparison as comparison_picture
from ..views import report as reporting
from ..workers.cluster import connected
from ..workers.processes import end_if_starting

if TYPE_CHECKING:
    from ..detectors.folder import TrainedDetector
    from ..detectors.predict import Predictions
    from ..detectors.source_comparison import SourceComparison
    from ..detectors.train import TrainOptions
    from ..trial.results import Results
    from ..trial.trial import TrialOptions


def render(model: SceneModel, scenes: Scenes, threads: int | None = None) -> RenderBatch:
    """Images and labels of scenes.

    Args:
        scenes: from ``sample``.
        threads: of the renderer; one a core where None.

    Raises:
        ModelError: a renderer of the user's own returns something wrong.
    """
    return renderer_for(model, threads)(scenes.drawing)


def generate(
    source: RunFolder | SceneModel | Path | str,
    num: int,
    out: Path | str,
    format: str | Iterable[str] = "coco",
    options: DatasetOptions | None = None,
    *,
    seed: int = 0,
    workers: int | str = 1,
    progress: bool = True,
) -> Dataset:
    """Write a labelled dataset; the same call goes on after an interruption.

    Args:
        source: a run or its folder, for the learnt structures; or a model, for the prior's.
        num: how many images.
        out: the folder to write, or an address of a file system that fsspec knows, such as ``s3://bucket/folder``.
        format: ``"coco"``, ``"panoptic"``, ``"yolo"``, ``"yolo-seg"``, ``"yolo-obb"``, ``"yolo-pose"``, ``"kitti"``,
            ``"webdataset"``, ``"depth"``, several of them, or ``"images"`` for no labels.
        options: what labels hold, and where files go.
        workers: processes that make a run's images, or the address of a Ray cluster whose nodes do, see ``Cluster``;
            the bytes do not depend on it. Several processes are spawned: a script calls this under
            ``if __name__ == "__main__":``.

    Raises:
        ProbsceneError: see ``generate_run``.
    """
    end_if_starting()
    options = options or DatasetOptions()
    if not isinstance(source, RunFolder | SceneModel) and not is_run(str(source)):
        source = load_model(str(source))
    with display(progress) as show:
        said = show.stage("generating")
        if isinstance(source, SceneModel):
            if workers != 1:
                raise ProbsceneError("expected one worker for a model in memory, got several; fit or name its file.")
            return generate_scenes(source, source.prior, num, out, seed, format, said, options)
        run = source if isinstance(source, RunFolder) else RunFolder.at(Path(source))
        processes, cluster = (1, workers) if isinstance(workers, str) else (workers, None)
        with connected(cluster, show.say) as nodes:
            return generate_run(run, num, out, seed, workers_or_cluster(processes, nodes), format, said, options)


def evaluate(
    run: RunFolder | Path | str,
    target: TargetImages | Target = None,
    labels: TargetLabels | Path | str | Labels | None = None,
    *,
    num: int = 10000,
    features: Sequence[str] = (),
    images: int | None = 1000,
    visible: Visible | None = None,
    progress: bool = True,
) -> Evaluation:
    """Count what the prior and the guide derive, beside the labels and what the run's network sees in the target.

    Args:
        target: the images to judge by; the run's own where None. Where it names no range of values of images of 16
            bits, the run's is taken.
        labels: of them, see ``TargetLabels``.
        num: structures a source.
        features: networks for KID and FID, such as ``["efficientnet"]``.
        images: at most so many a side for them; all of the target's where None.
        visible: least visible share of objects that are counted in rendered scenes, 0 to 1: one, or one for each class
            by name; where None, the run's, if its labels were read so.

    Raises:
        ProbsceneError: see ``evaluation.evaluate`` and ``read_labels``.
    """
    opened = run if isinstance(run, RunFolder) else RunFolder.at(Path(run))
    opened.check_finished()
    with display(progress) as show:
        seen = _images(opened, target, show)
        truth, compared = _truth(labels, opened.model, seen), evaluating.ImageComparison(features, images)
        return evaluating.evaluate(opened, seen, truth, show, num, compared=compared, visible=visible)


def compare(
    runs: Sequence[RunFolder | Path | str],
    target: TargetImages | Target = None,
    labels: TargetLabels | Path | str | Labels | None = None,
    out: Path | str | None = None,
    *,
    num: int = 10000,
    visible: Visible | None = None,
    progress: bool = True,
) -> Comparison:
    """The prior, several runs of one model and the truth side by side.

    Args:
        runs: themselves or their folders, which have different names.
        target: the images to judge by; the runs' own where None.
        labels: of them, see ``TargetLabels``.
        out: the picture to write, a PNG; none where None.
        num: structures a source.
        visible: see ``evaluate``.

    Raises:
        ProbsceneError: see ``evaluation.compare``.
    """
    opened = comparing.open_runs(runs)
    if out is not None:
        comparison_picture.make_folder_of(Path(out))
    first = next(iter(opened.values()))
    with display(progress) as show:
        images = None if target is None and labels is None else _images(first, target, show)
        truth = _truth(labels, first.model, images)
        found = comparing.compare(opened, images, truth, show, num, visible=visible)
        if out is not None:
            comparison_picture.draw(found, Path(out))
    return found


def report(
    run: RunFolder | Path | str,
    out: Path | str | None = None,
    labels: TargetLabels | Path | str | None = None,
    *,
    num: int = 10000,
    scenes: int | None = None,
    visible: Visible | None = None,
    progress: bool = True,
) -> Path:
    """Write one self-contained HTML page about a run; returns where it is.

    Args:
        out: the file; ``report.html`` in the run's folder where None.
        labels: of the run's target, see ``TargetLabels``.
        num: structures a source.
        scenes: rendered of prior and guide for the verdict, 1,000 where None; 0 for none.
        visible: see ``evaluate``.

    Raises:
        ProbsceneError: see ``views.report``.
    """
    opened = run if isinstance(run, RunFolder) else RunFolder.at(Path(run))
    with display(progress) as show:
        where, truth = None if out is None else Path(out), labels
        if isinstance(truth, Path | str):
            truth = TargetLabels(truth)
        return reporting.report(opened, show, where, truth, num, scenes, visible)


def trial(
    test: Path | str,
    out: Path | str,
    sets: Mapping[str, str | Path] | None = None,
    options: "TrialOptions | None" = None,
    *,
    workers: int = 1,
    progress: bool = True,
) -> "Results":
    """What is a labelled set worth? Train one detector, from one start and with one budget, on each of several sets,
    and test it on labelled real images; the same call goes on after an interruption.

    Args:
        test: labelled real images: a folder of COCO, KITTI or YOLO, a JSON file, or ``FOLDER@LIST``.
        out: the folder to write.
        sets: what each detector is shown, by name, such as ``{"rendered": "dataset/", "then 20": "rendered,real:20"}``;
            see ``trial.plan``.
        options: which photographs and sets of a run it compares, and how detectors are trained.
        workers: processes; the results do not depend on their number. More than one are spawned: a script calls this
            under ``if __name__ == "__main__":``.

    Raises:
        ProbsceneError: see ``trial.trial``.
    """
    end_if_starting()
    from ..trial import trial as trying  # torchvision takes seconds to import

    with display(progress) as show:
        options = options or trying.TrialOptions()
        return trying.trial(Path(test), Path(out), sets or {}, options, workers=workers, show=show, callback=show.say)


def train(
    source: RunFolder | SceneModel | Path | str,
    real: Path | str | None,
    labels: Path | str | None,
    out: Path | str,
    options: "TrainOptions | None" = None,
    *,
    workers: int = 1,
    progress: bool = True,
) -> "TrainedDetector":
    """Train a detector on what a run generates, then on labelled photographs where there are some, and keep it; the
    same call goes on after an interruption.

    Args:
        source: a run or its folder, for what it has learnt; or a model, for its prior.
        real: a folder of photographs, some of which ``labels`` are of; without ``labels``, a labelled set, as of
            ``trial``; None for none.
        labels: of photographs, with boxes: COCO's JSON, or a folder of KITTI or YOLO; without ``real``, a labelled set.
        out: the folder to write.
        options: what it is tested on, and how it is trained.
        workers: processes that generate a run's images; the bytes do not depend on their number. More than one are
            spawned: a script calls this under ``if __name__ == "__main__":``.

    Raises:
        ProbsceneError: see ``detectors.train``.
    """
    end_if_starting()
    from ..detectors import train as training  # torchvision takes seconds to import

    real, labels = (None if path is None else Path(path) for path in (real, labels))
    with display(progress) as show:
        options = options or training.TrainOptions()
        return training.train(source, real, labels, Path(out), options, workers=workers, show=show, callback=show.say)


def compare_sources(run: RunFolder, *, progress: bool = True) -> "SourceComparison | None":
    """Find out whether a detector is better for what was learnt: small ones are trained on each source of the run, and
    what they count in photographs of its target is compared with what the fit reads there. ``train`` takes the best.
    Learnt parameters are given back where detectors are better with the prior's.

    Returns:
        what was found; None where nothing was learnt, or nothing can be read in the photographs.

    Raises:
        ProbsceneError: the fit is not finished, or its target cannot be read.
    """
    end_if_starting()
    from ..detectors.source_comparison import compare_and_keep  # torchvision takes seconds to import

    with display(progress) as show:
        return compare_and_keep(run, open_target(run, show), show, show.say)


def predict(
    detector: "TrainedDetector | Path | str",
    photos: Path | str | Sequence[Path | str],
    out: Path | str,
    format: str = "coco",
    *,
    min_score: float | None = None,
    overlays: Path | str | None = None,
    skip_bad: bool = False,
    progress: bool = True,
) -> "Predictions":
    """Write what a detector finds in photographs, as labels that other calls read.

    Args:
        detector: what ``train`` gave, or its folder.
        photos: a folder of PNG, JPEG or TIFF images, an image, or several of these.
        out: the file to write, of COCO; or a new folder, of YOLO.
        format: ``"coco"``, whose annotations have a ``score``, or ``"yolo"``.
        min_score: least score of what is written, 0 to 1; where None, that at which the detector made fewest errors on
            held-out photographs, or 0.3 where there were none.
        overlays: a folder for each photograph with what was found drawn on it, and for ``label_next.txt``, the
            photographs that are worth labelling next.
        skip_bad: leave out files that do not decode.

    Raises:
        ProbsceneError: see ``detectors.predict``.
    """
    from ..detectors import predict as predicting  # torchvision takes seconds to import

    where = None if overlays is None else Path(overlays)
    with display(progress) as show:
        return predicting.predict(detector, photos, Path(out), format, min_score, where, skip_bad, show=show)


def display(progress: bool) -> Display:
    """Shows progress on stderr, or nothing."""
    return Display() if progress else Display(Console(quiet=True))


def _images(run: RunFolder, target: TargetImages | Target, show: Display) -> Images:
    if target is None:
        return open_target(run, show)
    given = target if isinstance(target, TargetImages) else TargetImages(target)
    skip_bad = run.record["skip_bad"] if given.skip_bad is None else given.skip_bad
    value_range = run.record.get("value_range") if given.value_range is None else given.value_range
    return open_images(given.source, run.model, skip_bad, show, value_range)


def _truth(
    labels: TargetLabels | Path | str | Labels | None, model: SceneModel, images: Images | None
) -> Labels | None:
    if labels is None or isinstance(labels, Labels):
        return labels
    assert images is not None
    return (TargetLabels(labels) if isinstance(labels, Path | str) else labels).read(model, images)
