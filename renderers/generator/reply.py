"""What a generator's answer has to be: each fault is one sentence. Axis letters: M nodes, H W."""

from typing import Any, NamedTuple

import numpy as np

_TYPES = {"image": "B", "instance": "bBhHiIlLqQnN", "depth": "f"}  # formats of memoryview
_BYTES: dict[tuple[str, float], type] = {
    ("instance", 2): np.uint16,
    ("depth", 4): np.float32,
}  # what plain bytes are, by how many a pixel has


class Fault(Exception):
    """What went wrong with a scene, in a sentence."""


class Picture(NamedTuple):
    """One scene, drawn.

    Attributes:
        image: ``(H, W, 3)`` uint8.
        instance: ``(H, W)`` int16, ids of nodes.
        depth: ``(H, W)`` float32 or None.
        amodal_box: ``(M, 4)`` float32 or None; zeros of nodes that cannot be seen and of which nothing was said.
    """

    image: np.ndarray
    instance: np.ndarray
    depth: np.ndarray | None
    amodal_box: np.ndarray | None


def parse_reply(record: dict[str, Any], reply: dict[str, Any], raw: bytes) -> Picture:
    """An answer to ``record``, see ``probscene.worker.packed``.

    Raises:
        Fault: it is another one.
    """
    if "error" in reply:
        raise Fault(f"its render(scene) raised an error; fix the program:\n{reply['error']}")
    arrays, at = {}, 0
    try:
        for each in reply["arrays"]:
            dtype = np.dtype(each["format"])
            size = int(np.prod(each["shape"], dtype=np.int64)) * dtype.itemsize
            arrays[each["name"]] = np.frombuffer(raw[at : at + size], dtype).reshape(each["shape"])
            at += size
        boxes = reply.get("amodal_box")
    except (KeyError, TypeError, ValueError) as error:
        raise Fault(f"it sent what is no answer of serve ({type(error).__name__}: {error})") from error
    height, width, most = record["height"], record["width"], max((node["id"] for node in record["nodes"]), default=0)
    image = _array(arrays, "image", (height, width, 3))
    ids = _array(arrays, "instance", (height, width))
    if ids.size and not (0 <= int(ids.min()) and int(ids.max()) <= most):
        raise Fault(
            f"expected ids of nodes of the scene in instance, 0 to {most}, got {int(ids.min())} to {int(ids.max())}"
        )
    none = set(range(1, most)) - {node["id"] for node in record["nodes"]}
    if none and (strange := np.isin(ids, list(none))).any():
        raise Fault(f"expected ids of nodes of the scene in instance, got {int(ids[strange][0])}, which is of none")
    depth = _array(arrays, "depth", (height, width)) if "depth" in arrays else None
    if depth is not None and np.isnan(depth).any():
        raise Fault("expected depth without NaN, got NaN; infinity where there is sky")
    return Picture(image, ids.astype(np.int16), depth, None if boxes is None else _boxes(boxes, most, ids))


def _array(arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    if name not in arrays:
        raise Fault(f"expected {name} of shape {shape}, got none")
    value, size = arrays[name], int(np.prod(shape))
    if value.ndim == 1 and value.dtype == np.uint8 and size:
        value = value.view(_BYTES.get((name, value.size / size), np.uint8))
    if value.ndim == 1 and value.size == size:
        value = value.reshape(shape)
    if value.shape != shape or value.dtype.char not in _TYPES[name]:
        kind = {"image": "uint8", "instance": "integers", "depth": "float32"}[name]
        more = "; leave its alpha out" if name == "image" and value.shape[2:] == (4,) else ""
        raise Fault(f"expected {name} as {kind} {shape}, got {value.dtype} {value.shape}{more}")
    return value


def _boxes(boxes: Any, most: int, ids: np.ndarray) -> np.ndarray:
    found = np.zeros((most, 4), np.float32)
    try:
        for id, box in boxes:
            x0, y0, x1, y1 = (float(end) for end in box)
            if not (1 <= id <= most and x0 <= x1 and y0 <= y1 and np.isfinite([x0, y0, x1, y1]).all()):
                raise ValueError(f"{id}: {box}")
            found[id - 1] = x0, y0, x1, y1
    except (TypeError, ValueError) as error:
        raise Fault(
            f"expected amodal_box as a dict of a node's id and x0, y0, x1, y1 in pixels with x0 <= x1 and y0 <= y1, "
            f"got {error}"
        ) from error
    shown = np.setdiff1d(ids, 0)
    empty = shown[(found[shown - 1, 2:] <= found[shown - 1, :2]).any(1)]
    if len(empty):
        raise Fault(
            f"expected amodal_box of each node that instance shows, larger than 0, got none of node {empty[0]}; "
            "give all of them, or none"
        )
    return found
