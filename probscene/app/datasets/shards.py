"""WebDataset: tar files of 1,024 images with their labels, for readers that stream.

    shard-000000.tar ...   000000.png, 000000.json, 000001.png, ...

A JSON file holds ``classes``, ``height``, ``width``, ``annotations`` (COCO's, and ``class``, the name) and
``provenance``, the image's line; where the program names keypoints, ``keypoints`` has their names by class. Owners and
times are zero, so that equal samples are equal bytes.
"""

import io
import json
import tarfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from probscene.model import SceneModel

from ..chunks import CHUNK

CHUNKS = 16  # of a shard
SIZE = CHUNKS * CHUNK  # images of a shard


def shard_name(number: int) -> str:
    """The file of shard number ``number``, relative to the dataset's folder."""
    return f"shard-{number:06d}.tar"


def labels(model: SceneModel, record: dict[str, Any]) -> Iterator[tuple[int, bytes]]:
    """The index and the JSON file of every image of a chunk's record."""
    height, width = model.canvas
    found: dict[int, list] = {line["index"]: [] for line in record["provenance"]}
    for annotation in record["annotations"]:
        rest = {key: value for key, value in annotation.items() if key != "image_id"}
        found[annotation["image_id"]].append({"class": model.classes[annotation["category_id"] - 1], **rest})
    names = {"keypoints": record["keypoints"]} if record["keypoints"] else {}
    for line in record["provenance"]:
        sample = {
            "classes": list(model.classes),
            **names,
            "height": height,
            "width": width,
            "annotations": found[line["index"]],
            "provenance": line,
        }
        yield line["index"], json.dumps(sample, ensure_ascii=False, separators=(",", ":")).encode("utf-8")


def write(path: Path, samples: Iterable[tuple[int, dict[str, bytes]]]) -> None:
    """A whole shard of samples, each an index and its files by ending; one sample is in memory at a time."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for index, files in samples:
            for ending, contents in files.items():
                member = tarfile.TarInfo(f"{index:06d}.{ending}")
                member.size = len(contents)
                tar.addfile(member, io.BytesIO(contents))
