"""COCO panoptic: every pixel in a segment, in the format of cocodataset.org.

    panoptic.json
    panoptic/000000.png ...   a pixel's colour is its segment's id, R + 256 G + 256 ** 2 B; 0 where there is none

Things are the objects that other formats label, each a segment. Stuff has one segment an image and class: the model's
own ``stuff``, kinds that are no classes, and what is no object: of worlds the sky, the ground's surfaces and
decoration, in 2D and of generators ``background``. Without a segment are objects that have no label for their
``min_visible``. Categories are the model's classes, with the ids that they have in ``annotations.json``, then the
others. The ids of segments are spread over all colours, so that neighbours look different.
"""

import json
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from probscene.batch import RenderBatch
from probscene.model import SceneModel

from . import coco
from .provenance import stem

_SPREAD = 0x9E3779  # odd, so that times it, numbers below 2 ** 24 differ modulo 2 ** 24


def file_name(index: int, flat: bool = True) -> str:
    """The file of image number ``index``, relative to the dataset's folder; see ``stem``."""
    return f"panoptic/{stem(index, flat)}.png"


def segments(
    model: SceneModel, batch: RenderBatch, found: list[dict[str, Any]], first: int, min_visible: float
) -> tuple[dict[str, Any], list[bytes]]:
    """What ``write`` takes of rendered scenes, and their files.

    Args:
        batch: the renders, of images ``first``, ``first + 1``, ...
        found: their annotations, see ``coco.annotations``.
    """
    rest_names = ("background",) if batch.space is None else batch.space.names
    names = [*dict.fromkeys((*model.classes, *rest_names, *model.grammar.kinds))]
    labelled = coco.labelled(model, batch, min_visible).numpy()
    M = labelled.shape[1]
    # What is seen, as a number: node + 1 of a thing, M + category of stuff, 0 for an object without a label.
    stuff = {name: 0 if name in model.classes else M + i for i, name in enumerate(names, 1)}
    of_kind, of_rest = (np.array([*(stuff[name] for name in some), 0]) for some in (model.grammar.kinds, rest_names))
    is_thing = np.array([False, *(name not in model.stuff for name in model.classes)])
    entries, files, boxes = [], [], iter(annotation["bbox"] for annotation in found)
    for i, category in enumerate(labelled):
        of_node = np.where(category > 0, M + category, of_kind[batch.kind[i].numpy()])
        of_node = np.where(is_thing[category], np.arange(1, M + 1), of_node)
        instance = batch.instance[i].numpy()
        rest = np.zeros_like(instance) if batch.space is None else batch.space.semantic[i].numpy()
        seen = np.where(instance > 0, np.append(of_node, 0)[instance - 1], of_rest[rest])
        ids = seen * _SPREAD & 0xFFFFFF
        bgr = np.stack([ids >> 16, ids >> 8 & 0xFF, ids & 0xFF], -1).astype(np.uint8)
        files.append(cv2.imencode(".png", bgr)[1].tobytes())
        things = (category.nonzero()[0] + 1).tolist()
        box_of = dict(zip(things, islice(boxes, len(things)), strict=True))
        info = []
        for number in np.unique(seen[seen > 0]):
            mask = seen == number
            info.append(
                {
                    "id": int(number * _SPREAD & 0xFFFFFF),
                    "category": names[(category[number - 1] if number <= M else number - M) - 1],
                    "area": int(mask.sum()),
                    "bbox": box_of[number] if number <= M else _box(mask),
                    "iscrowd": 0,
                }
            )
        entries.append({"image_id": first + i, "segments_info": info})
    return {"names": names, "annotations": entries}, files


def write(
    path: Path, model: SceneModel, num: int, info: dict[str, Any], found: Iterable[dict[str, Any]], flat: bool = True
) -> None:
    """The whole file, for ``num`` images.

    Args:
        found: what ``segments`` gave, in order; it is not kept.
        flat: see ``stem``.
    """
    number: dict[str, int] = {}

    def annotations() -> Iterator[dict[str, Any]]:
        for some in found:
            for name in some["names"]:
                number.setdefault(name, len(number) + 1)
            for entry in some["annotations"]:
                for segment in entry["segments_info"]:
                    segment["category_id"] = number[segment.pop("category")]
                yield {"file_name": f"{stem(entry['image_id'], flat)}.png", **entry}

    def categories() -> Iterator[dict[str, Any]]:
        things = {*model.classes} - {*model.stuff}
        for name, i in number.items():
            yield {"id": i, "name": name, "supercategory": model.name, "isthing": int(name in things)}

    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.write(f'{{"info": {json.dumps(info)},\n"licenses": []')
        coco.write_list(file, "images", coco.images(model, num, flat))
        coco.write_list(file, "annotations", annotations())
        coco.write_list(file, "categories", categories())
        file.write("}\n")


def _box(mask: np.ndarray) -> list[int]:
    rows, columns = np.nonzero(mask)
    x, y = int(columns.min()), int(rows.min())
    return [x, y, int(columns.max()) + 1 - x, int(rows.max()) + 1 - y]
