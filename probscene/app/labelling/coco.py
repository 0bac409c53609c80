"""COCO's JSON: ``images``, ``annotations`` with a ``bbox``, ``categories`` by name; other keys are not read.

An image that is listed and has no annotation shows nothing; one that is not listed is not labelled. A crowd
(``iscrowd``) is one annotation of an unknown number of objects: an image with one of a labelled class has no known
counts, and is taken as not labelled, which a note says. Annotations that are marked ``ignore`` or ``difficult`` are
counted as all others.
"""

import json
from pathlib import Path
from typing import Any

from probscene.dataset import Images
from probscene.errors import DataError
from probscene.model import SceneModel

from .boxes import Box, Boxes, finite, on_canvas, place
from .counts import text_of
from .naming import NamedImages, base_name, labelled_classes

LISTS = ("images", "annotations", "categories")


def read_coco(path: Path, model: SceneModel, target: Images, some: bool = False, min_height: float = 0.0) -> Boxes:
    """The boxes of a target's images. Entries of files that the target left out as bad are passed over.

    Args:
        some: there need not be an entry for every image; those without are left out.
        min_height: of a box that is counted, pixels of its file.

    Raises:
        DataError: no such file or no COCO, an image that is not there, is twice there, has another size or none of
            whose entries is; an annotation of no image or category, or whose box is none or beside its image; no
            category that the model has a class for. The first is named.
    """
    path = Path(path)
    whole = _whole(path)
    categories: dict[int | str, str] = {}
    for i, entry in enumerate(whole["categories"]):
        where = place(path, "categories", i)
        categories[_new_id(entry, categories, where)] = _text(entry, "name", where)
    expected = f"categories among the classes of model {model.name!r} ({', '.join(model.classes)})"
    classes, notes = labelled_classes(categories.values(), model.classes, expected, path)
    named = NamedImages(path, target, some)
    names = _names(path, whole["images"], named)
    crowded: set[str] = set()
    for i, entry in enumerate(whole["annotations"]):
        where = place(path, "annotations", i)
        image, category = _known(entry, "image_id", names, where), _known(entry, "category_id", categories, where)
        box = _box(entry, category, where)
        if category in classes and image in named.found:
            if entry.get("iscrowd"):
                crowded.add(image)
            named.found[image].append(box)
    for image in crowded:
        del named.found[image]
    named.unknown = crowded
    if crowded:
        notes += (
            f"{len(crowded)} images are taken as not labelled, since a crowd (iscrowd) says not how many it has: "
            f"{', '.join(sorted(crowded)[:5])}{' ...' if len(crowded) > 5 else ''}.",
        )
    return on_canvas(target, named.rows(), named.ordered(), classes, notes, min_height)


def _whole(path: Path) -> dict[str, list[Any]]:
    try:
        whole = json.loads(text_of(path))
    except (ValueError, RecursionError) as error:
        raise DataError(f"Expected COCO's JSON in {path}, actual something else ({error}).") from error
    missing = [key for key in LISTS if not isinstance(whole, dict) or not isinstance(whole.get(key), list)]
    if missing:
        raise DataError(
            f"Expected COCO's JSON with lists of {', '.join(LISTS)} in {path}, actual none of {', '.join(missing)}."
        )
    return whole


def _names(path: Path, images: list[Any], named: NamedImages) -> dict[int | str, str]:
    """The file's name of each image by its id; those of the target that are used get an empty list in ``named``."""
    names: dict[int | str, str] = {}
    size = {file.name: size for file, size in zip(named.target.paths, named.target.sizes, strict=True)}
    for i, entry in enumerate(images):
        where = place(path, "images", i)
        key, name = _new_id(entry, names, where), base_name(_text(entry, "file_name", where))
        names[key] = name
        if not named.wanted(name, where):
            continue
        named.found[name] = []
        said = entry.get("height"), entry.get("width")
        if None not in said and said != size[name]:
            raise DataError(
                f"Expected {name} to be {said[1]}x{said[0]} as {where}, actual {size[name][1]}x{size[name][0]}; "
                "give labels of these images, not of images of another size."
            )
    return names


def _box(entry: dict[str, Any], name: str, where: str) -> Box:
    box = entry.get("bbox")
    if not isinstance(box, list) or len(box) != 4 or not finite(box) or min(box[2:]) <= 0:
        raise DataError(
            f"Expected bbox: x, y, and a width and height above 0 {where}, actual {json.dumps(box)}; mend or delete it."
        )
    x, y, width, height = box
    return Box(name, x, y, x + width, y + height, height, where)


def _new_id(entry: Any, known: dict[int | str, str], where: str) -> int | str:
    key = entry.get("id") if isinstance(entry, dict) else None
    if isinstance(key, int | str) and key not in known:
        return key
    raise DataError(f"Expected an id that no other entry has {where}, actual {json.dumps(key)}; mend the entry.")


def _text(entry: dict[str, Any], key: str, where: str) -> str:
    text = entry.get(key)
    if not isinstance(text, str) or not text:
        raise DataError(f"Expected a {key} {where}, actual {json.dumps(text)}; mend the entry.")
    return text


def _known(entry: Any, key: str, known: dict[int | str, str], where: str) -> str:
    found = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(found, int | str) or found not in known:
        raise DataError(f"Expected {key} to be an id that is listed {where}, actual {json.dumps(found)}; mend it.")
    return known[found]
