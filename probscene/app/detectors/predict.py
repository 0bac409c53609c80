"""What a trained detector finds in photographs, as labels; see ``predict``.

    predicted.json                                      COCO: images, categories, and annotations with a score
    predicted/data.yaml, predicted/labels/NAME.txt      YOLO: the names of the classes, and a file for each photograph

Which photographs are worth labelling next is told by the 1-vs-2 margin [1]: a detection of score s counts
``(1 - |2 s - 1|)²``, most at 0.5, and a photograph the sum of its detections, also of those below the least score.

References:
    [1] Brust, Käding, Denzler, *Active Learning for Deep Object Detection*, VISAPP 2019.
"""

import json
import os
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from probscene.dataset import listed, range_of
from probscene.decoding import eight_bit, quiet, read, stored
from probscene.errors import DataError, ProbsceneError
from probscene.image_bytes import Fault
from probscene.threads import threads

from ..files import make_folder, write_json, write_text
from ..labels.naming import printable
from ..pictures import write_picture
from ..progress import Display
from ..trial.sets import MAX_NAMED_IMAGES, digest_of_pixels
from ..trial.training import Detections
from .folder import DEFAULT_MIN_SCORE, TrainedDetector
from .overlays import overlay

FORMATS = ("coco", "yolo")
NUM_NEXT = 10  # photographs that are proposed for labelling
NEXT = "label_next.txt"
DECIMALS = 2  # of boxes, pixels


class Predictions(NamedTuple):
    """What was found.

    Attributes:
        path: of the file or the folder that was written.
        images: of each photograph its name there.
        found: in each, from ``min_score`` on.
        classes: their names.
        min_score: the least score.
        reason: why it is that, in words.
        label_next: names of photographs that are worth labelling next, the first most; none that the detector was
            trained or tested on.
    """

    path: Path
    images: tuple[str, ...]
    found: tuple[Detections, ...]
    classes: tuple[str, ...]
    min_score: float
    reason: str
    label_next: tuple[str, ...]


def predict(
    detector: TrainedDetector | Path | str,
    photos: Path | str | Sequence[Path | str],
    out: Path,
    format: str = "coco",
    min_score: float | None = None,
    overlays: Path | None = None,
    skip_bad: bool = False,
    *,
    show: Display,
) -> Predictions:
    """Write what a detector finds in photographs, whole or not at all.

    Args:
        detector: itself or its folder.
        photos: a folder of PNG, JPEG or TIFF images, an image, or several of these.
        out: the file to write, of COCO; or a folder that is new or empty, of YOLO.
        format: ``"coco"`` or ``"yolo"``, which has no scores.
        min_score: least score of what is written, 0 to 1; where None, that at which the detector made fewest errors on
            held-out photographs, or 0.3 where there were none.
        overlays: a folder for each photograph with what was found drawn on it, and for ``label_next.txt``.
        skip_bad: leave out files that do not decode.
        show: says how far it is, and notes on the photographs.

    Raises:
        ProbsceneError: a setting that makes no sense.
        DataError: no detector, a damaged one, no image, or one that does not decode; ``out`` is a folder, or of YOLO
            one that holds files.
        MachineError: it cannot be written.
    """
    if format not in FORMATS:
        raise ProbsceneError(f"expected the format coco or yolo, got {format!r}.")
    if min_score is not None and not 0 <= min_score <= 1:
        raise ProbsceneError(f"expected a lowest score from 0 to 1, got {min_score}.")
    out = Path(out)
    if format == "yolo" and out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise DataError(f"expected a new or empty folder for YOLO's labels, got {out}, which is none; name another.")
    if format == "coco" and out.is_dir():
        raise DataError(
            f"expected a file to write, got the folder {out}; name one in it, such as {out}/predicted.json."
        )
    trained = detector if isinstance(detector, TrainedDetector) else TrainedDetector.at(detector)
    files = _files([photos] if isinstance(photos, str | os.PathLike) else photos)
    names = _names(files, format)
    if out.resolve() in {file.resolve() for file in files}:
        raise ProbsceneError(f"expected a file of its own to write, got the photograph {out}; name another.")
    pictures = [None if overlays is None else _picture(overlays, name) for name in names]
    if {path.resolve().parent for path in pictures if path} & {file.resolve().parent for file in files}:
        raise ProbsceneError(f"expected another folder for overlays than that of the photographs, got {overlays}.")
    _ = trained.network  # before anything is written
    make_folder(out.parent)
    value_range, notes = range_of(files, trained.value_range)
    for note in notes:
        show.say(f"Note: {note}")
    least, reason = _least(trained, min_score)
    known = {each["digest"] for key in ("photographs", "held_out") for each in trained.record.get(key, ())}
    if overlays is not None:
        make_folder(overlays)
    seen, bad = list[_Seen](), list[str]()
    with quiet(), threads(1):
        for number, (file, name, picture) in enumerate(zip(files, names, pictures, strict=True), 1):
            try:
                pixels, size = stored(read(file))
            except Fault as fault:
                bad.append(f"{file.name} {fault}")
                continue
            image = _rgb(eight_bit(pixels, value_range))
            found = trained(image)
            unsure = 0.0 if digest_of_pixels(pixels) in known else uncertainty(found.scores)
            kept = _from(found, least)
            seen.append(_Seen(name, size, kept, unsure))
            if picture is not None:
                make_folder(picture.parent)
                write_picture(picture, overlay(image, kept, trained.classes))
            show("detecting", number, len(files))
    _judge(bad, len(files), skip_bad, show)
    order = sorted((each for each in seen if each.uncertainty > 0), key=lambda each: -each.uncertainty)
    chosen = tuple(each.name for each in order[:NUM_NEXT])
    if format == "yolo":
        _write_yolo(out, seen, trained.classes)
    else:
        write_json(out, _coco(seen, trained.classes))
    if overlays is not None:
        write_text(overlays / NEXT, "".join(f"{name}\n" for name in chosen))
    images, found = tuple(each.name for each in seen), tuple(each.found for each in seen)
    return Predictions(out, images, found, trained.classes, least, reason, chosen)


def uncertainty(scores: NDArray[np.float32]) -> float:
    """How unsure a detector is of what it finds in a photograph: the sum of its detections' 1-vs-2 margins."""
    return float(((1 - np.abs(2 * scores.astype(np.float64) - 1)) ** 2).sum())


class _Seen(NamedTuple):
    """A photograph: its name in what is written, height and width, what was found, and how unsure the detector is."""

    name: str
    size: tuple[int, int]
    found: Detections
    uncertainty: float


def _files(photos: Sequence[Path | str]) -> list[Path]:
    """All images that are named, each once."""
    found: list[Path] = []
    for place in map(Path, photos):
        if place.is_file():
            found.append(place)
        else:
            found += listed(place)[0]
    if not found:
        raise DataError("expected photographs, got an empty list; name a folder or images.")
    return list({file.resolve(): file for file in found}.values())


def _names(files: Sequence[Path], format: str) -> list[str]:
    """The photographs' names in what is written: from the folder that has them all."""
    folders = [file.absolute().parent for file in files]
    common = Path(os.path.commonpath(folders))
    names = [
        printable((folder / file.name).relative_to(common).as_posix())
        for folder, file in zip(folders, files, strict=True)
    ]
    stems = [str(Path(name).with_suffix("")) for name in names]
    number = Counter(stems)
    twice = [name for name, stem in zip(names, stems, strict=True) if number[stem] > 1]
    if format == "yolo" and twice:
        raise DataError(
            f"expected photographs of different names for YOLO, whose labels leave out the ending, got "
            f"{', '.join(twice[:2])}; rename one, or write COCO."
        )
    return names


def _picture(overlays: Path, name: str) -> Path:
    return overlays / (name if name.lower().endswith(".png") else f"{name}.png")


def _least(trained: TrainedDetector, given: float | None) -> tuple[float, str]:
    """The least score, and why it is that."""
    if given is not None:
        return given, "as given"
    if trained.min_score is None:
        return DEFAULT_MIN_SCORE, "as no labelled photographs were held out to choose it by"
    scores = trained.record["scores"]
    return (
        trained.min_score,
        f"where the detector made fewest errors on {scores['images']} held-out photographs: {scores['errors']} false "
        f"or missed, of {sum(scores['objects'].values())} objects",
    )


def _from(found: Detections, least: float) -> Detections:
    """What has at least that score, boxes as they are written, without those that are nothing then."""
    boxes = np.round(found.boxes.astype(np.float64), DECIMALS)
    keep = (found.scores >= least) & (boxes[:, 2:] > boxes[:, :2]).all(1)
    return Detections(boxes[keep].astype(np.float32), found.classes[keep], found.scores[keep])


def _rgb(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.dstack([pixels] * 3) if pixels.ndim == 2 else pixels


def _judge(bad: list[str], number: int, skip_bad: bool, show: Display) -> None:
    if not bad:
        return
    more = f" and {len(bad) - MAX_NAMED_IMAGES} more" if len(bad) > MAX_NAMED_IMAGES else ""
    words = f"{', '.join(bad[:MAX_NAMED_IMAGES])}{more}"
    if not skip_bad or len(bad) == number:
        raise DataError(
            f"expected images that decode, got {len(bad)} of {number} bad: {words}; fix or delete them"
            f"{', or skip them with --skip-bad' if len(bad) < number else ''}."
        )
    show.say(f"Note: {len(bad)} bad files are left out: {words}.")


def _coco(seen: Sequence[_Seen], classes: tuple[str, ...]) -> dict[str, Any]:
    images, labels = list[dict[str, Any]](), list[dict[str, Any]]()
    for i, (name, (height, width), found, _) in enumerate(seen, 1):
        images.append({"id": i, "file_name": name, "width": width, "height": height})
        for box, c, score in zip(found.boxes.astype(np.float64), found.classes, found.scores, strict=True):
            x0, y0, x1, y1 = (round(float(v), DECIMALS) for v in box)
            sides = [round(x1 - x0, DECIMALS), round(y1 - y0, DECIMALS)]
            labels.append({
                "id": len(labels) + 1, "image_id": i, "category_id": int(c) + 1, "bbox": [x0, y0, *sides],
                "area": round(sides[0] * sides[1], DECIMALS), "iscrowd": 0, "score": round(float(score), 6),
            })  # fmt: skip
    categories = [{"id": number, "name": name} for number, name in enumerate(classes, 1)]
    return {"images": images, "annotations": labels, "categories": categories}


def _write_yolo(out: Path, seen: Sequence[_Seen], classes: tuple[str, ...]) -> None:
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as aside:
        whole = make_folder(Path(aside) / "whole")
        folder = make_folder(whole / "labels")
        names = "".join(f"  {i}: {json.dumps(name, ensure_ascii=False)}\n" for i, name in enumerate(classes))
        write_text(whole / "data.yaml", f"train: images\nval: images\nnames:\n{names}")
        for name, (height, width), found, _ in seen:
            lines = []
            for (x0, y0, x1, y1), c in zip(found.boxes.astype(np.float64), found.classes, strict=True):
                shares = (x0 + x1) / 2 / width, (y0 + y1) / 2 / height, (x1 - x0) / width, (y1 - y0) / height
                lines.append(" ".join([str(c), *(f"{share:.8f}" for share in shares)]) + "\n")
            file = (folder / name).with_suffix(".txt")
            make_folder(file.parent)
            write_text(file, "".join(lines))
        if out.is_dir():
            out.rmdir()
        os.replace(whole, out)
