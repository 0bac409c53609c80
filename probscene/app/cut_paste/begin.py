"""``probscene begin``: a model file made of a few labelled photographs, with the pictures that it draws beside it.

The folder that it writes:

    model.py             the model, to read and edit
    cutouts/CLASS/*.png  objects, RGBA; those that are deleted are no longer drawn
    cutouts.png          all of them at a glance
    grounds/*.png        the photographs without their objects
    labels.json          the labels (COCO), with the model's names of classes
    begun.json           which photographs these pictures are of; they must not stand in a test
"""

import keyword
import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console

from probscene.dataset import ImageFolder, listed
from probscene.decoding import quiet, read, stored, window
from probscene.errors import DataError
from probscene.image_bytes import Fault

from ..arguments import checked_seed
from ..files import machine_error, make_folder, write_json, write_text
from ..labels.kitti import DONT_CARE
from ..labels.naming import composed, matched
from ..labels.reading import read_annotations
from ..progress import Display, Progress
from ..trial.begun_photographs import FILE
from ..trial.sets import digest_of_pixels
from .cutouts import Cutout, Object, are_whole, covered, cut_out, inside, overlaps, parents, turned
from .detections import Photograph, object_on_canvas, read_detections
from .grounds import ground_of, light_of
from .model_file import ClassPart, ModelPart, model_text

AREA = 342 * 342  # pixels of the canvas at most: what counting heads see of an image
MAX_CUTOUTS = 80  # of a class
MAX_GROUNDS = 60
MIN_CUTOUTS = 5  # of a class; with fewer a note says how little that is
MIN_CONTRAST = 1.3  # of a cut-out; less is noise, or a label of nothing
OUTLIER = 3.5  # robust standard deviations of the logarithm of a mask's area
MIN_TO_CHOOSE = 8  # cut-outs of a class, to leave out unusual ones
OVERLAPPING = 0.1  # of a box that another covers, from which on objects overlap
WHOLE_IMAGE = 0.9  # of an image, that a box may cover
IGNORE = "ignore"  # the class of what is no object
LIGHTS = 0.9  # of the photographs, whose light a model's exposure covers
MARGIN = 0.05  # of the canvas, by which places go on beyond those seen


@dataclass(frozen=True, kw_only=True)
class BeginOptions:
    """How a model is made.

    Args:
        name: of the model; its folder's where None.
        canvas: height and width of its scenes, pixels; that of most photographs, reduced to ``AREA``, where None.
        turn: whether objects lie in any direction; by class as their cut-outs do where None.
        ignore: classes of what looks like an object and is none, drawn without a label.
        detections: what a detector has found in the photographs, see ``predict``. Those without labels become grounds,
            too, filled in where something was found. What was found in labelled ones where no label is becomes a
            distractor, of the first class of ``ignore``.
        value_range: of photographs of 16 bits, see ``ImageFolder``.
        seed: of the noise in grounds, and of the choice among many cut-outs.
    """

    name: str | None = None
    canvas: tuple[int, int] | None = None
    turn: bool | None = None
    ignore: tuple[str, ...] = (IGNORE,)
    detections: Path | str | None = None
    value_range: Sequence[float] | None = None
    seed: int = 0


class BegunModel(NamedTuple):
    """What ``begin`` wrote.

    Attributes:
        path: the model's file.
        cutouts: of each class, how many there are.
        objects: of each class, how many are labelled.
        grounds: how many.
        notes: what a person should know, one sentence each.
    """

    path: Path
    cutouts: Mapping[str, int]
    objects: Mapping[str, int]
    grounds: int
    notes: tuple[str, ...]


class _Photographs(NamedTuple):
    """The labelled photographs as the canvas has them."""

    images: list[NDArray[np.uint8]]  # (H, W, 3)
    objects: list[list[Object]]
    there: list[NDArray[np.bool_]]  # (H, W), where objects or crowds are
    folder: ImageFolder
    notes: tuple[str, ...]
    others: dict[Path, Photograph]  # without labels, in which a detector has looked for objects


class _Roles(NamedTuple):
    """The classes that are drawn without a label; and those that lie on another, by name, see ``cutouts.inside``."""

    ignored: set[str]
    on: dict[str, str]


def begin(
    photos: Path | str,
    labels: Path | str,
    out: Path | str,
    options: BeginOptions = BeginOptions(),
    *,
    progress: bool = True,
) -> BegunModel:
    """Make a model of labelled photographs: their objects are cut out, their grounds filled in, and a program pastes
    the ones on the others [1]. Its prior has flat counts up to half again of what the labels have.

    Args:
        photos: the folder of the photographs; those without labels are not looked at.
        labels: of some of them, with boxes or masks: COCO, KITTI or YOLO.
        out: the folder to write, new or empty.

    Raises:
        DataError: see ``read_annotations``, ``ImageFolder`` and ``matched``; no labelled photograph, or no object that
            can be cut out; the folder holds files.

    References:
        [1] Dwibedi, Misra, Hebert, *Cut, Paste and Learn*, ICCV 2017.
    """
    out, photos = Path(out), Path(photos)
    checked_seed(options.seed)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DataError(f"expected a new or empty folder for the model, got {out}, which holds files; name another.")
    with Display() if progress else Display(Console(quiet=True)) as show:
        return _begin(photos, Path(labels), out, options, show)


def _begin(photos: Path, labels: Path, out: Path, options: BeginOptions, show: Progress) -> BegunModel:
    found = _photographs(photos, labels, options)
    kinds = _kinds(found.objects)
    rng, notes = np.random.default_rng(options.seed), list(found.notes)
    light = float(np.median([light_of(*pair) for pair in zip(found.images, found.there, strict=True)]))
    relation = inside(found.objects)
    whole = [are_whole(objects, relation, found.folder.canvas) for objects in found.objects]
    pairs = [pair for each in zip(found.objects, whole, strict=True) for pair in zip(*each, strict=True)]
    always = set(kinds) - {one.name for one, is_whole in pairs if is_whole}
    notes += [
        f"{n}: every object is cut by the border or covered by another, and is drawn as it is." for n in sorted(always)
    ]
    cut: dict[str, list[Cutout]] = {name: [] for name in kinds}
    empty: list[Photograph] = []  # their ``there`` is what was filled in

    def fill(image: NDArray[np.uint8], there: NDArray[np.bool_]) -> None:
        gain = light / max(light_of(image, there), 1.0)
        filled = np.clip(ground_of(image, there, rng) * gain, 0, 255).round().astype(np.uint8)
        empty.append(Photograph(filled, there))

    for i, (image, objects, there) in enumerate(zip(found.images, found.objects, found.there, strict=True)):
        which = np.array(
            [is_whole or one.name in always for one, is_whole in zip(objects, whole[i], strict=True)], bool
        )
        for one, cutout in zip(objects, cut_out(image, objects, which, light), strict=True):
            if cutout is not None:
                cut[one.name].append(cutout)
        fill(image, there)
        show("cutting", i + 1, len(found.images))
    for other in found.others.values():
        fill(*other)
    if renamed := [f"{name} is {kind}" for name, kind in kinds.items() if name != kind]:
        notes.append(f"Classes are renamed in the model and in labels.json: {', '.join(renamed)}.")
    ignored = {name for name in kinds if composed(name) in map(composed, options.ignore)}
    chosen = {name: _chosen(name, some, rng, notes) for name, some in cut.items()}
    lacking = [name for name, some in chosen.items() if not some]
    if len(lacking) == len(chosen) or not set(chosen) - ignored - set(lacking):
        raise DataError(
            f"expected objects in {labels} that can be cut out, got none of {', '.join(kinds) or 'any class'}; label "
            "some that are at least a few pixels wide."
        )
    for name in lacking:
        notes.append(f"{name}: no object could be cut out, so that the model has no such class; label larger ones.")
    if len(empty) == 1:
        notes.append("Only one photograph is labelled, so scenes have one background. Label a few more.")
    best = sorted(np.argsort([each.there.mean() for each in empty], kind="stable")[:MAX_GROUNDS])
    usable = {n: on for n, on in relation.items() if chosen[n] and chosen[on] and not {n, on} & ignored}
    model = _model(found, chosen, kinds, _Roles(ignored, usable), options, out)
    grounds = [empty[i].image for i in best]
    _write(out, model, {kinds[n]: c for n, c in chosen.items() if c}, grounds, found, kinds)
    number = Counter(one.name for each in found.objects for one in each)
    return BegunModel(
        out / "model.py",
        {name: len(some) for name, some in chosen.items()},
        {name: number[name] for name in kinds},
        len(grounds),
        tuple(notes),
    )


def _photographs(photos: Path, path: Path, options: BeginOptions) -> _Photographs:
    labels = read_annotations(path)
    files = listed(photos)[0]
    pairs = matched(labels.images, files, photos, stems=labels.stems)
    if not pairs.entries:
        raise DataError(
            f"expected labels of photographs in {photos}, got none of them in {path}; label at least one, by the name "
            "of its file."
        )
    named = [files[i] for i in pairs.entries]
    detections = None if options.detections is None else read_detections(options.detections, files, photos)
    sizes = ImageFolder(named, (64, 64), 3, value_range=options.value_range).sizes
    folder = ImageFolder(named, options.canvas or _canvas(sizes), 3, value_range=options.value_range)
    images = [folder.load(i).permute(1, 2, 0).contiguous().numpy() for i in range(len(folder))]
    objects, there, dropped = [], [], Counter[str]()
    for i, entry in enumerate(pairs.entries.values()):
        found = [(one, object_on_canvas(one, folder, i, labels)) for one in labels.read(entry, folder.sizes[i])]
        mine = [(one, o) for one, o in found if one.name != DONT_CARE]
        crowds = [o for one, o in mine if one.crowd and o is not None]
        kept = []
        for one, o in mine:
            if o is None:
                dropped["lie where photographs are cut to the canvas"] += 1
            elif not one.crowd and o.size**2 > WHOLE_IMAGE * folder.canvas[0] * folder.canvas[1]:
                dropped["cover the whole photograph"] += 1
            elif not one.crowd:
                kept.append(o)
        if detections is not None and options.ignore:
            labelled = [o for _, o in found if o is not None]  # DontCare, too
            kept += detections.distractors(folder, i, labelled, composed(options.ignore[0]))
        objects.append(kept)
        there.append(covered([*kept, *crowds], folder.canvas))
    notes, others = [*pairs.notes, *folder.notes], dict[Path, Photograph]()
    if detections is not None:
        unlabelled = [file for file in files if file in detections.entries and file not in named]
        if len(unlabelled) > MAX_GROUNDS:
            some = np.random.default_rng([options.seed, 1]).choice(len(unlabelled), MAX_GROUNDS, replace=False)
            unlabelled = [unlabelled[i] for i in sorted(some)]
        others = dict(zip(unlabelled, detections.photographs(unlabelled, folder), strict=True))
        notes += detections.notes
    notes += [f"Left out: {number} objects that {why}." for why, number in dropped.items()]
    if not any(objects):
        raise DataError(f"expected objects in {path}, got none in {len(named)} photographs; label some.")
    return _Photographs(images, objects, there, folder, tuple(dict.fromkeys(notes)), others)


def _canvas(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The size to which the most photographs are brought without a cut, reduced to ``AREA``."""
    common = Counter(sizes)
    height, width = max(
        sorted(common), key=lambda size: (sum(window(other, size) is None for other in sizes), common[size])
    )
    scale = min(1.0, (AREA / (height * width)) ** 0.5)
    return max(8, round(height * scale)), max(8, round(width * scale))


def _kinds(objects: Iterable[Iterable[Object]]) -> dict[str, str]:
    """By the names of classes what they are called in the grammar, large ones first."""
    size: dict[str, list[float]] = {}
    for each in objects:
        for one in each:
            size.setdefault(one.name, []).append(one.size)
    kinds: dict[str, str] = {}
    for name in sorted(size, key=lambda name: (-float(np.median(size[name])), name)):
        kind = re.sub(r"[^\w\-]+", "_", name).strip("_-") or "object"
        kind = kind[0].lower() + kind[1:]  # of a nonterminal the first letter is upper-case
        while kind in kinds.values() or kind == "ε":
            kind += "_"
        kinds[name] = kind
    return kinds


def _python_name(name: str) -> str:
    name = re.sub(r"\W", "_", name)
    return name if name.isidentifier() and not keyword.iskeyword(name) else f"model_{name}"


def _chosen(name: str, some: list[Cutout], rng: np.random.Generator, notes: list[str]) -> list[Cutout]:
    """The cut-outs of a class that are drawn."""
    clear = [one for one in some if one.contrast >= MIN_CONTRAST]
    if clear and len(clear) < len(some):
        notes.append(f"{name}: {len(some) - len(clear)} objects that look like their background are not drawn.")
        some = clear
    if len(some) >= MIN_TO_CHOOSE:
        area = np.log([max((one.rgba[..., 3] > 127).sum(), 1) for one in some])
        off = np.abs(area - np.median(area))
        usual = off <= OUTLIER * max(1.4826 * float(np.median(off)), 0.1)
        some = [one for one, keep in zip(some, usual, strict=True) if keep]
    if some and len(some) < MIN_CUTOUTS:
        objects = "object is" if len(some) == 1 else "objects are"
        notes.append(f"{name}: {len(some)} {objects} all that scenes show of it. Label more, for other looks.")
    if len(some) > MAX_CUTOUTS:
        some = [some[i] for i in sorted(rng.choice(len(some), MAX_CUTOUTS, replace=False))]
    return some


def _model(
    found: _Photographs,
    chosen: Mapping[str, list[Cutout]],
    kinds: Mapping[str, str],
    roles: _Roles,
    options: BeginOptions,
    out: Path,
) -> ModelPart:
    """What the file says."""
    height, width = found.folder.canvas
    parts, lists = [], [parents(each, roles.on) for each in found.objects]
    for name, cutouts in chosen.items():
        if not cutouts:
            continue
        number, middles, objects = [], [], 0
        for each, under in zip(found.objects, lists, strict=True):
            mine = [(one, each[on] if on is not None else None) for one, on in zip(each, under, strict=True)]
            mine = [(one, on) for one, on in mine if one.name == name]
            objects += len(mine)
            if name in roles.on:
                number += [sum(on is of for _, on in mine) for of in each if of.name == roles.on[name]]
                middles += [np.subtract(one.middle, on.middle) for one, on in mine if on is not None]
            else:
                number.append(len(mine))
                middles += [np.array(one.middle) for one, _ in mine]
        low, high = np.min(middles, 0), np.max(middles, 0)
        if name not in roles.on:
            low = np.maximum(low - (MARGIN * width, MARGIN * height), 0)
            high = np.minimum(high + (MARGIN * width, MARGIN * height), (width, height))
        turn = turned([one.direction for one in cutouts]) if options.turn is None else options.turn
        parts.append(
            ClassPart(
                kinds[name], name in roles.ignored, max(number), (min(number), max(number)), objects, len(cutouts),
                (float(low[0]), float(high[0]) + 0.1), (float(low[1]), float(high[1]) + 0.1), turn,
                kinds[roles.on[name]] if name in roles.on else "",
            )
        )  # fmt: skip
    labelled = [[one for one in each if one.name not in roles.ignored] for each in found.objects]
    most = max((float(overlaps(each).max(initial=0.0)) for each in labelled if each), default=0.0)
    radius = float(np.median([one.size for each in labelled for one in each] or [1.0])) / 2
    lights = [light_of(*pair) for pair in zip(found.images, found.there, strict=True)]
    off = np.abs(np.log(np.maximum(lights, 1.0) / np.median(np.maximum(lights, 1.0))))
    grey = all((image == image[..., :1]).all() for image in found.images)
    return ModelPart(
        _python_name(options.name or out.resolve().name),
        (height, width),
        1 if grey else 3,
        tuple(parts),
        len(found.images),
        most > OVERLAPPING,
        radius,
        float(np.quantile(off, LIGHTS)),
    )


def _write(
    out: Path,
    model: ModelPart,
    cutouts: Mapping[str, list[Cutout]],
    grounds: list[NDArray[np.uint8]],
    found: _Photographs,
    kinds: Mapping[str, str],
) -> None:
    """The folder, whole or not at all."""
    make_folder(out.resolve().parent)
    try:
        aside = Path(tempfile.mkdtemp(dir=out.resolve().parent, prefix=f".{out.name}."))
    except OSError as error:
        raise machine_error(error, out) from error
    try:
        for kind, some in cutouts.items():
            _save([one.rgba for one in some], aside / "cutouts" / kind)
        _save(grounds, aside / "grounds")
        Image.fromarray(_sheet(cutouts)).save(aside / "cutouts.png")
        write_text(aside / "model.py", model_text(model))
        write_json(aside / "labels.json", _labels(found, kinds))
        seen = [_known(file) for file in (*found.folder.paths, *found.others)]
        write_json(aside / FILE, {"format": 1, "photographs": seen})
        aside.chmod(0o755)
        if out.is_dir():
            out.rmdir()
        os.replace(aside, out)
    except OSError as error:
        raise machine_error(error, out) from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _save(pictures: Sequence[NDArray[np.uint8]], folder: Path) -> None:
    folder.mkdir(parents=True)
    for i, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{i:03d}.png")


def _known(file: Path) -> dict[str, str]:
    """A photograph by its name and its pixels, see ``trial.sets.Example.digest``."""
    try:
        with quiet():
            return {"name": file.name, "digest": digest_of_pixels(stored(read(file))[0])}
    except Fault as fault:
        raise DataError(f"expected a photograph in {file}, got a file that {fault}.") from fault


def _labels(found: _Photographs, kinds: Mapping[str, str]) -> dict[str, Any]:
    """COCO of the boxes, in pixels of the files."""
    images, annotations = [], []
    H, W = found.folder.canvas
    for i, (file, objects) in enumerate(zip(found.folder.paths, found.objects, strict=True)):
        size = found.folder.sizes[i]
        top, left, height, width = found.folder.windows[i] or (0, 0, *size)
        images.append({"id": i + 1, "file_name": file.name, "height": size[0], "width": size[1]})
        for one in objects:
            x0, y0, x1, y1 = np.array(one.box) * ((width / W, height / H) * 2) + ((left, top) * 2)
            annotations.append(
                {
                    "id": len(annotations) + 1, "image_id": i + 1, "category_id": list(kinds).index(one.name) + 1,
                    "bbox": [round(float(v), 3) for v in (x0, y0, x1 - x0, y1 - y0)], "iscrowd": 0,
                    "area": round(float((x1 - x0) * (y1 - y0)), 3),
                }
            )  # fmt: skip
    categories = [{"id": i + 1, "name": kind} for i, kind in enumerate(kinds.values())]
    return {"images": images, "annotations": annotations, "categories": categories}


def _sheet(cutouts: Mapping[str, list[Cutout]], side: int = 72, columns: int = 16) -> NDArray[np.uint8]:
    """All cut-outs on grey, with the names of their files."""
    font, rows = ImageFont.load_default(11), sum(1 + -(-len(some) // columns) for some in cutouts.values())
    sheet = Image.new("RGB", (columns * side, rows * (side + 14)), (128, 128, 128))
    draw, row = ImageDraw.Draw(sheet), 0
    for kind, some in cutouts.items():
        draw.text((4, row * (side + 14) + side - 6), f"cutouts/{kind}", (255, 255, 255), ImageFont.load_default(18))
        for i, one in enumerate(some):
            at, line = i % columns * side, (row + 1 + i // columns) * (side + 14)
            picture = Image.fromarray(one.rgba)
            scale = (side - 4) / max(picture.size)
            picture = picture.resize([max(1, round(scale * v)) for v in picture.size])
            sheet.paste(picture, (at + 2, line), picture)
            draw.text((at + 2, line + side - 3), f"{i:03d}", (230, 230, 230), font)
        row += 1 + -(-len(some) // columns)
    return np.asarray(sheet)
