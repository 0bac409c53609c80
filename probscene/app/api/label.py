"""``probscene label``: which images to label next, and the sheet to count in."""

from pathlib import Path

import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.errors import DataError
from probscene.inference.features.base import FeatureNet, objects_counted
from probscene.model import SceneModel

from ..arguments import checked_seed, positive
from ..evaluation.estimate import class_counts
from ..fitting.begin import ModelFile
from ..fitting.run import RunFolder, is_run
from ..labels.partial_labels import PartialLabels, read_partial_labels
from ..labels.selection import propose
from ..labels.sheet import Sheet, check_empty, write_sheet
from ..loading import load_model
from ..progress import Display, Progress
from ..targets import Target, TargetImages, open_images
from .calls import display

CONSIDERED = 2000  # images at most that are looked at, evenly spread over all
AT_ONCE = 16


def label(
    source: RunFolder | SceneModel | ModelFile | Path | str,
    target: TargetImages | Target,
    out: Path | str,
    number: int = 10,
    labels: Path | str | None = None,
    *,
    seed: int = 0,
    progress: bool = True,
) -> Sheet:
    """Propose which images to label next, see ``labels.selection``, and write the sheet to count in.

    Args:
        source: a run, whose network's counts say which images to take, as far as it has some; or a model.
        target: the images. Where it names no range of values of images of 16 bits, a run's is taken.
        out: the folder to write, new or empty.
        number: images to propose; fewer where fewer are left.
        labels: of images that are labelled already, see ``read_partial_labels``; they are not proposed, and the sheet
            asks for the same classes and has their counts, too.
        seed: of the first image.

    Raises:
        ProbsceneError: the folder holds files already, or all images are labelled; see ``read_partial_labels`` and
            ``open_images``.
    """
    out = Path(out)
    positive(number, "images")
    checked_seed(seed)
    check_empty(out)
    run, model = _source(source)
    given = target if isinstance(target, TargetImages) else TargetImages(target)
    with display(progress) as show:
        value_range = given.value_range
        if value_range is None and run is not None:
            value_range = run.record.get("value_range")
        images = open_images(given.source, model, bool(given.skip_bad), show, value_range)
        few = None if labels is None else read_partial_labels(Path(labels), model, images, min_images=1)
        rows = _proposed(run, model, images, number, few, seed, show)
    if not rows:
        raise DataError(f"expected images without labels in {images.path}, got all {len(images)} labelled.")
    classes = model.classes if few is None else few.classes
    return write_sheet(out, images, rows, classes, model.name, _cells(images, few))


def _source(source: RunFolder | SceneModel | ModelFile | Path | str) -> tuple[RunFolder | None, SceneModel]:
    if isinstance(source, SceneModel):
        return None, source
    if not isinstance(source, RunFolder):
        file = source if isinstance(source, ModelFile) else ModelFile(str(source))
        if not is_run(str(file.reference)):
            return None, load_model(str(file.reference), file.assets)
        source = RunFolder.at(Path(str(file.reference)))
    return source, source.model


def _proposed(
    run: RunFolder | None,
    model: SceneModel,
    images: Images,
    number: int,
    few: PartialLabels | None,
    seed: int,
    show: Display,
) -> list[int]:
    from probscene.inference.features.pretrained import pretrained  # torchvision takes seconds to import

    labelled = [] if few is None else few.rows.tolist()
    spread = [i * len(images) // CONSIDERED for i in range(CONSIDERED)] if len(images) > CONSIDERED else None
    considered = list(range(len(images))) if spread is None else sorted({*spread, *labelled})
    if spread is not None:
        show.say(f"Note: {len(considered)} of {len(images)} images are considered, evenly spread over all.")
    nets: list[FeatureNet] = [pretrained("efficientnet")]
    own = None if run is None else run.network()
    if own is not None and class_counts(model, tuple(own.names), torch.zeros(0, len(own.names))) is not None:
        nets.append(own)
    elif run is not None:
        show.say("Note: the run has no network that counts; images are chosen by appearance alone.")
    looks, *found = _seen(images, considered, nets, show)
    counts = None
    if found:
        counts = class_counts(model, tuple(nets[1].names), objects_counted(nets[1], found[0]))
    before = torch.tensor([considered.index(row) for row in labelled])
    chosen = propose(number, looks, counts, before, seed)
    return [considered[i] for i in chosen]


@torch.no_grad()
def _seen(images: Images, considered: list[int], nets: list[FeatureNet], progress: Progress) -> list[Tensor]:
    """The features ``(L, D)`` of images by each network."""
    parts: list[list[Tensor]] = [[] for _ in nets]
    for first in range(0, len(considered), AT_ONCE):
        some = torch.stack([images.load(row) for row in considered[first : first + AT_ONCE]])
        for net, part in zip(nets, parts, strict=True):
            part.append(net.embed(some))
        progress("target", first + len(some), len(considered), "")
    return [torch.cat(part) for part in parts]


def _cells(images: Images, few: PartialLabels | None) -> dict[str, list[str]]:
    if few is None:
        return {}
    names = [images.paths[row].name for row in few.rows.tolist()]
    return {name: [str(count) for count in counts] for name, counts in zip(names, few.counts.tolist(), strict=True)}
