"""COCO: the labels of a dataset in the format of cocodataset.org, written one annotation at a time.

Beyond the format's own keys an annotation has ``visible_fraction``, visible pixels over those of the whole silhouette,
and ``amodal_bbox``, the box of the whole silhouette, which others may cover and the canvas may cut. Of a 3D scene it
also has ``truncated``, the share of that box beyond the canvas, and ``box_3d``: height, width, length, x, y, z and
rotation as in ``SceneGeometry``; ``visible_fraction`` is then of the silhouette within the canvas. What a renderer does
not know is left out, see ``RenderBatch.unknown``.

Where the program's sprites name keypoints, categories have ``keypoints``, their names, and an empty ``skeleton``, and
annotations ``keypoints``, x, y and visibility of each, and ``num_keypoints``, see ``probscene.keypoints``; x and y are
in the pixels of boxes, in which the middle of the upper left one is (0.5, 0.5). On request, annotations have
``amodal_segmentation``, the run lengths of the whole silhouette within the image, and ``attributes``, the program's own
values by site.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TextIO, cast

import torch
from pycocotools import mask as rle
from torch import Tensor

from probscene.batch import RenderBatch
from probscene.errors import ProbsceneError
from probscene.keypoints import Keypoints
from probscene.model import SceneModel

from .provenance import stem

More = Callable[[int, int], dict[str, Any]]
"""What else the annotation of a scene's node has, by their indices."""


def categories(model: SceneModel, keypoints: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """The model's classes, with ids from 1.

    Args:
        keypoints: names of keypoints by class.
    """
    return [
        {"id": i, "name": name, "supercategory": model.name}
        | ({"keypoints": [*keypoints[name]], "skeleton": []} if keypoints and name in keypoints else {})
        for i, name in enumerate(model.classes, 1)
    ]


def check_min_visible(min_visible: float) -> None:
    """See that a least visible fraction is one.

    Raises:
        ProbsceneError: it is not in 0..1.
    """
    if not 0 <= min_visible <= 1:
        raise ProbsceneError(f"expected min_visible from 0 to 1, got {min_visible}.")


def check_margin_classes(model: SceneModel, margin: int | dict[str, int]) -> None:
    """See that a model has the classes that a margin names.

    Raises:
        ProbsceneError: it has not.
    """
    unknown = [] if isinstance(margin, int) else sorted(margin.keys() - set(model.classes))
    if unknown:
        raise ProbsceneError(
            f"expected box_margin of classes of model {model.name!r} ({', '.join(model.classes)}), got "
            f"{', '.join(unknown)}."
        )


def node_margins(model: SceneModel, batch: RenderBatch, margin: int | dict[str, int]) -> Tensor:
    """``(N, M)`` int64 of each node."""
    if isinstance(margin, int):
        return torch.full_like(batch.kind, margin, dtype=torch.int64)
    of_kind = torch.tensor([margin.get(kind, 0) for kind in model.grammar.kinds])
    return of_kind[batch.kind.long().clamp(min=0)] * (batch.kind >= 0)


def with_margin(model: SceneModel, batch: RenderBatch, margin: int | dict[str, int]) -> RenderBatch:
    """The batch with boxes of what is visible that are wider on each side, as far as the image goes: people box objects
    more loosely than a mask does. Whole silhouettes' boxes stay.

    Args:
        margin: see ``checked_box_margin``.
    """
    if not margin:
        return batch
    height, width = batch.image.shape[2:]
    wider = batch.box + torch.tensor([-1, -1, 1, 1]) * node_margins(model, batch, margin)[..., None]
    wider = torch.minimum(wider.clamp(min=0), torch.tensor([width, height, width, height]))
    return batch._replace(box=torch.where(batch.pixels[..., None] > 0, wider, batch.box))


def labelled(model: SceneModel, batch: RenderBatch, min_visible: float = 0.0) -> Tensor:
    """The category ids ``(N, M)`` int64 of the nodes that are labelled in every format: those of a class that have a
    visible pixel, and of which at least the fraction ``min_visible`` is visible; 0 at the others.

    Raises:
        ProbsceneError: a ``min_visible`` where the renderer does not know what is visible.
    """
    category = torch.tensor([_category(model, name) for name in model.grammar.kinds])
    if min_visible and "visible" in batch.unknown:
        raise ProbsceneError(
            f"expected no min_visible with model {model.name!r}, whose generator does not say which share of an object "
            f"is visible, got {min_visible:g}; leave it out."
        )
    shown = (batch.kind >= 0) & (batch.pixels > 0) & (batch.visible >= min_visible)
    return torch.where(shown, category[batch.kind.clamp(min=0)], 0)


def annotations(
    model: SceneModel, batch: RenderBatch, first: int, min_visible: float = 0.0, more: Iterable[More] = ()
) -> list[dict[str, Any]]:
    """Annotations of rendered scenes, but for their ids: one for each node that is ``labelled``.

    Args:
        batch: the renders, of images ``first``, ``first + 1``, ...
    """
    category = labelled(model, batch, min_visible)
    found = []
    for i in range(len(category)):
        nodes = category[i].nonzero()[:, 0]
        for node, mask in zip(nodes.tolist(), _masks(batch.instance[i], nodes), strict=True):
            found.append(
                {
                    "image_id": first + i,
                    "category_id": int(category[i, node]),
                    "bbox": _corner_and_size(batch.box[i, node]),
                    "segmentation": mask,
                    "area": int(batch.pixels[i, node]),
                    "iscrowd": 0,
                    **_whole(batch, i, node),
                    **_in_space(batch, i, node),
                }
            )
            for of in more:
                found[-1] |= of(i, node)
    return found


def with_keypoints(model: SceneModel, keypoints: Keypoints) -> More:
    """What annotations have of keypoints."""

    def of(scene: int, node: int) -> dict[str, Any]:
        kind = model.grammar.kinds[int(kinds[scene, node])]
        if kind not in keypoints.names:
            return {}
        points = keypoints.points[scene, node, : len(keypoints.names[kind])].tolist()
        flat = [value for x, y, seen in points for value in (round(x, 3), round(y, 3), int(seen))]
        return {"keypoints": flat, "num_keypoints": sum(seen > 0 for seen in flat[2::3])}

    kinds = keypoints.kind
    return of


def with_amodal(masks: Iterable[tuple[int, int, Tensor]]) -> More:
    """What annotations have of masks of whole objects, see ``amodal.masks``."""
    encoded = {(i, node): _encoded(mask.T.contiguous()[None])[0] for i, node, mask in masks}
    return lambda scene, node: {"amodal_segmentation": encoded[scene, node]}


def write(
    path: Path,
    model: SceneModel,
    num: int,
    info: dict[str, Any],
    found: Iterable[dict[str, Any]],
    flat: bool = True,
    keypoints: dict[str, Any] | None = None,
) -> None:
    """The whole file, for ``num`` images; annotations get ids from 1 in the order they come, and are not kept.

    Args:
        flat: see ``stem``.
        keypoints: see ``categories``.
    """
    numbered = ({"id": number, **annotation} for number, annotation in enumerate(found, 1))
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        kinds = json.dumps(categories(model, keypoints))
        file.write(f'{{"info": {json.dumps(info)},\n"licenses": [],\n"categories": {kinds}')
        write_list(file, "images", images(model, num, flat))
        write_list(file, "annotations", numbered)
        file.write("}\n")


def images(model: SceneModel, num: int, flat: bool) -> Iterator[dict[str, Any]]:
    """The entries of images 0 to ``num - 1``."""
    height, width = model.canvas
    return ({"id": i, "file_name": f"{stem(i, flat)}.png", "height": height, "width": width} for i in range(num))


def write_list(file: TextIO, key: str, entries: Iterable[dict[str, Any]]) -> None:
    """A further key of an object, of entries that are not kept."""
    file.write(f',\n"{key}": [')
    file.writelines(_lines(entries))
    file.write("]")


def _lines(entries: Iterable[dict[str, Any]]) -> Iterator[str]:
    for number, entry in enumerate(entries):
        yield ("\n" if number == 0 else ",\n") + json.dumps(entry, separators=(",", ":"))


def _category(model: SceneModel, kind: str) -> int:
    """The id of a kind's category; 0 for a kind that is not labelled."""
    return model.classes.index(kind) + 1 if kind in model.classes else 0


def _masks(instance: Tensor, nodes: Tensor) -> list[dict[str, Any]]:
    """Compressed run lengths of the visible masks of some nodes of one image, ``instance (H, W)``."""
    if not len(nodes):
        return []
    columns = instance.T.contiguous()  # runs go down the columns
    return _encoded(columns == (nodes + 1).view(-1, 1, 1).to(columns.dtype))


def _encoded(columns: Tensor) -> list[dict[str, Any]]:
    """Compressed run lengths of K masks, ``columns (K, W, H)`` bool."""
    encoded = cast(list[dict[str, Any]], rle.encode(columns.numpy().view("uint8").transpose(2, 1, 0)))
    return [{"size": mask["size"], "counts": mask["counts"].decode("ascii")} for mask in encoded]


def _whole(batch: RenderBatch, i: int, node: int) -> dict[str, Any]:
    """What an annotation says of the whole silhouette, where that is known."""
    found: dict[str, Any] = {}
    if "visible" not in batch.unknown:
        found["visible_fraction"] = round(float(batch.visible[i, node]), 6)
    if "amodal_box" not in batch.unknown:
        found["amodal_bbox"] = _corner_and_size(batch.amodal_box[i, node])
    return found


def _in_space(batch: RenderBatch, i: int, node: int) -> dict[str, Any]:
    """What an annotation has beside the rest in 3D, where a silhouette's ends are between pixels."""
    if batch.space is None:
        return {}
    x0, y0, x1, y1 = batch.amodal_box[i, node].tolist()
    return {
        "amodal_bbox": [round(v, 3) for v in (x0, y0, x1 - x0, y1 - y0)],
        "truncated": round(float(batch.space.truncated[i, node]), 6),
        "box_3d": [round(v, 5) for v in batch.space.box[i, node].tolist()],
    }


def _corner_and_size(box: Tensor) -> list[int]:
    """Of the whole pixels that a box touches; a generator's may end between them."""
    x0, y0 = (math.floor(v) for v in box[:2])
    x1, y1 = (math.ceil(v) for v in box[2:])
    return [x0, y0, x1 - x0, y1 - y0]
