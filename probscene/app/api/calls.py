"""What is done with a run or a model: images, datasets, evaluations, reports."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from rich.console import Console

from probscene.batch import RenderBatch
from probscene.dataset import Images
from probscene.errors import ProbsceneError
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.sampling import Scenes

from ..datasets.generate import Dataset, DatasetOptions, generate_scenes, workers_or_cluster
from ..datasets.generate import generate as generate_run
from ..evaluation import compare as comparing
from ..evaluation import evaluate as evaluating
from ..evaluation.compare import Comparison
from ..evaluation.evaluate import Evaluation
from ..evaluation.labels import Labels, read_labels
from ..evaluation.visible import Visible
from ..fitting.pipeline import open_target
from ..fitting.run import RunFolder, is_run
from ..loading import load_model, renderer_for
from ..progress import Display
from ..targets import Target, open_images
from ..trial import trial as trying
from ..trial.results import Results
from ..views import comparison as comparison_picture
from ..views import report as reporting
from ..workers.cluster import connected
from ..workers.processes import end_if_starting


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
    seed: int = 0,
    workers: int = 1,
    progress: bool = True,
    policy: Policy | None = None,
    min_visible: float = 0.0,
    shard: str | None = None,
    cluster: str | None = None,
    flat: bool = False,
    box_margin: int = 0,
    amodal: bool = False,
    values: str | Iterable[str] = (),
) -> Dataset:
    """Write a labelled dataset; the same call goes on after an interruption.

    Args:
        source: a run or its folder, for the learnt structures; or a model, for the prior's.
        num: how many images.
        out: the folder to write, or an address of a file system that fsspec knows, such as ``s3://bucket/folder``.
        format: ``"coco"``, ``"panoptic"``, ``"yolo"``, ``"yolo-seg"``, ``"yolo-obb"``, ``"yolo-pose"``, ``"kitti"``,
            ``"webdataset"``, ``"depth"``, several of them, or ``"images"`` for no labels.
        workers: processes of a run's generation; the bytes do not depend on their number. More than one are spawned: a
            script calls this under ``if __name__ == "__main__":``.
        policy: other structures for a model.
        min_visible: objects of which a smaller fraction is visible have no label, in any format.
        shard: ``"I/N"``, I from 0: one of N calls that make the dataset together, see ``generate_run``.
        cluster: the address of a Ray cluster whose nodes make a run's images, see ``Cluster``.
        flat, box_margin, amodal, values: see ``generate_run``.

    Raises:
        ProbsceneError: see ``generate_run``.
    """
    end_if_starting()
    with display(progress) as show:
        said = show.stage("generating")
        options = DatasetOptions(
            min_visible=min_visible, flat=flat, box_margin=box_margin, amodal=amodal, values=values, shard=shard
        )
        if not isinstance(source, RunFolder | SceneModel) and not is_run(str(source)):
            source = load_model(str(source))
        if isinstance(source, SceneModel):
            if workers != 1 or cluster is not None:
                raise ProbsceneError("expected one worker for a model in memory, got several; fit or name its file.")
            policy = policy or source.prior
            return generate_scenes(source, policy, num, out, seed, format, said, options)
        run = source if isinstance(source, RunFolder) else RunFolder.at(Path(source))
        with connected(cluster, show.say) as nodes:
            return generate_run(run, num, out, seed, workers_or_cluster(workers, nodes), format, said, options)


def evaluate(
    run: RunFolder | Path | str,
    target: Target | None = None,
    labels: Path | str | Labels | None = None,
    num: int = 10000,
    features: Sequence[str] = (),
    images: int | None = 1000,
    some_labels: bool = False,
    min_height: float = 0.0,
    progress: bool = True,
    visible: Visible | None = None,
    value_range: Sequence[float] | None = None,
) -> Evaluation:
    """Count what the prior and the guide derive, beside the labels and what the run's network sees in the target.

    Args:
        target: the images to judge by; the run's own where None.
        labels: ``counts.csv``, COCO's ``.json``, ``provenance.jsonl``, KITTI's folder ``label_2`` or YOLO's ``labels``.
        num: structures a source.
        features: networks for KID and FID, such as ``["efficientnet"]``.
        images: at most so many a side for them; all of the target's where None.
        some_labels: labels need not cover all images.
        min_height: of objects that labels with boxes count, pixels.
        visible: least visible share of objects that are counted in rendered scenes, 0 to 1: one, or one for each class
            by name; where None, the run's, if its labels were read so.
        value_range: of a target's images of 16 bits, see ``ImageFolder``; the run's, if it has one, where None.

    Raises:
        ProbsceneError: see ``evaluation.evaluate`` and ``read_labels``.
    """
    opened = run if isinstance(run, RunFolder) else RunFolder.at(Path(run))
    opened.check_finished()
    with display(progress) as show:
        seen = _images(opened, target, show, value_range)
        truth = _truth(labels, opened.model, seen, some_labels, min_height)
        return evaluating.evaluate(opened, seen, truth, show, num, features=features, images=images, visible=visible)


def compare(
    runs: Sequence[RunFolder | Path | str],
    target: Target | None = None,
    labels: Path | str | Labels | None = None,
    out: Path | str | None = None,
    num: int = 10000,
    min_height: float = 0.0,
    progress: bool = True,
    visible: Visible | None = None,
    some_labels: bool = False,
) -> Comparison:
    """The prior, several runs of one model and the truth side by side.

    Args:
        runs: themselves or their folders, which have different names.
        target: the images to judge by; the runs' own where None.
        labels: see ``evaluate``.
        out: the picture to write, a PNG; none where None.
        num: structures a source.
        visible, some_labels: see ``evaluate``.

    Raises:
        ProbsceneError: see ``evaluation.compare``.
    """
    opened = comparing.open_runs(runs)
    if out is not None:
        comparison_picture.make_folder_of(Path(out))
    first = next(iter(opened.values()))
    with display(progress) as show:
        images = None if target is None and labels is None else _images(first, target, show)
        truth = _truth(labels, first.model, images, some_labels, min_height)
        found = comparing.compare(opened, images, truth, show, num, visible=visible)
        if out is not None:
            comparison_picture.draw(found, Path(out))
    return found


def report(
    run: RunFolder | Path | str,
    out: Path | str | None = None,
    labels: Path | str | None = None,
    num: int = 10000,
    scenes: int | None = None,
    progress: bool = True,
    visible: Visible | None = None,
    some_labels: bool = False,
) -> Path:
    """Write one self-contained HTML page about a run; returns where it is.

    Args:
        out: the file; ``report.html`` in the run's folder where None.
        labels: of the run's target, see ``evaluate``.
        num: structures a source.
        scenes: rendered of prior and guide for the verdict, 1,000 where None; 0 for none.
        visible, some_labels: see ``evaluate``.

    Raises:
        ProbsceneError: see ``views.report``.
    """
    opened = run if isinstance(run, RunFolder) else RunFolder.at(Path(run))
    with display(progress) as show:
        where, truth = None if out is None else Path(out), None if labels is None else Path(labels)
        return reporting.report(opened, show, where, truth, num, scenes, visible, some_labels)


def trial(
    test: Path | str,
    out: Path | str,
    sets: Mapping[str, str | Path] | None = None,
    *,
    hold_out: int | None = None,
    real: Path | str | None = None,
    numbers: Iterable[int | None] | None = None,
    run: RunFolder | Path | str | None = None,
    sources: Sequence[str] = ("prior", "start", "learnt"),
    generated: int = 600,
    min_visible: float = 0.2,
    box_margin: int = 0,
    classes: Iterable[str] | None = None,
    detector: str = "efficientnet",
    budget: trying.Budget | None = None,
    size: tuple[int, int] | None = None,
    seeds: int = 5,
    seed: int = 0,
    baselines: Iterable[str] = (),
    resamples: int = 1000,
    workers: int = 1,
    progress: bool = True,
    value_range: Sequence[float] | None = None,
) -> Results:
    """What is a labelled set worth? Train one detector, from one start and with one budget, on each of several sets,
    and test it on labelled real images; the same call goes on after an interruption.

    Args:
        test: labelled real images: a folder of COCO, KITTI or YOLO, a JSON file, or ``FOLDER@LIST``.
        out: the folder to write.
        sets: what each detector is shown, by name, such as ``{"rendered": "dataset/", "then 20": "rendered,real:20"}``;
            see ``trial.plan``.
        hold_out: so many images of ``test`` are for testing, the others are ``"real"``.
        real: other labelled photographs to train on.
        numbers: of them, with a set each, None for all; 10, 20, 50 and all where not given.
        run: a run or its folder, of which ``sources`` are generated, ``generated`` images each, without labels for
            objects of which less than ``min_visible`` is visible, and with boxes that are ``box_margin`` pixels wider
            on each side.
        classes: those that it is about; else all, which are then the same in all sets.
        detector: ``"efficientnet"``, or ``"maskrcnn=FILE"`` with torchvision's weights.
        budget: how each is trained.
        size: height and width at which images come, multiples of 32.
        seeds: trainings of each set.
        seed: of everything random.
        baselines: sets that the others are compared with; the first where there is none.
        resamples: of test images and seeds, for intervals.
        workers: processes; the results do not depend on their number. More than one are spawned: a script calls this
            under ``if __name__ == "__main__":``.
        value_range: of photographs of 16 bits, see ``trial.trial``.

    Raises:
        ProbsceneError: see ``trial.trial``.
    """
    end_if_starting()
    made = None
    if run is not None:
        opened = run if isinstance(run, RunFolder) else RunFolder.at(Path(run))
        made = trying.Generated(opened, tuple(sources), generated, min_visible, box_margin)
    with display(progress) as show:
        options = trying.TrialOptions(
            hold_out=hold_out,
            real=None if real is None else Path(real),
            numbers=numbers,
            generated=made,
            classes=classes,
            detector=detector,
            budget=budget or trying.Budget(),
            size=size,
            seeds=seeds,
            seed=seed,
            baselines=baselines,
            resamples=resamples,
            value_range=value_range,
        )
        return trying.trial(Path(test), Path(out), sets or {}, options, workers=workers, show=show, callback=show.say)


def display(progress: bool) -> Display:
    """Shows progress on stderr, or nothing."""
    return Display() if progress else Display(Console(quiet=True))


def _images(run: RunFolder, target: Target | None, show: Display, value_range: Sequence[float] | None = None) -> Images:
    if target is not None:
        value_range = run.record.get("value_range") if value_range is None else value_range
        return open_images(target, run.model, run.record["skip_bad"], show, value_range)
    return open_target(run, show)


def _truth(
    labels: Path | str | Labels | None, model: SceneModel, images: Images | None, some: bool, min_height: float
) -> Labels | None:
    if labels is None or isinstance(labels, Labels):
        return labels
    assert images is not None
    return read_labels(Path(labels), model, images, some, min_height)
