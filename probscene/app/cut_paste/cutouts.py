"""Objects cut out of labelled photographs.

Where labels have boxes alone, an object is separated from the ground by GrabCut [1], which is told that all outside the
box is ground; the largest part is taken. Where that finds hardly anything, an ellipse in the box is taken. Axis
letters: H W of the canvas, h w of a cut-out, n objects of an image.

References:
    [1] Rother, Kolmogorov, Blake, *GrabCut*, SIGGRAPH 2004.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

MARGIN = 6  # pixels of the photograph around a cut-out, for feathering
FINE = 96  # pixels: a smaller patch is enlarged for GrabCut
ITERATIONS = 4  # of GrabCut
MIN_FILLED = 0.3  # of its box, that an object fills
MAX_COVERED = 0.1  # of a box, by another one
GAP = 0.12  # of an object's width, that is closed in its outline
SMOOTH = 0.7  # pixels of the blur of a mask's edge
RING = 4  # pixels around an object, whose light is the ground's
AROUND = 1.15  # times a box's sides, of the ellipse that an object may fill
MIN_SIDE = 3.0  # pixels of a box
MAX_GAIN = 2.0  # and one over that
LARGER = 1.5  # times the side of a box, that what it lies on has
CONTAINED, MOSTLY, MIN_INSIDE = 0.9, 0.8, 5  # of a box, in what it lies on; the share of boxes; objects at least
AXIS_RATIO = 1.25  # of a mask's axes, from which on it has a direction
ALIGNED = 0.6  # mean resultant length of directions, from which on they are one


class Object(NamedTuple):
    """A labelled object.

    Attributes:
        name: of its class.
        box: x0, y0, x1, y1, pixels of the canvas.
        mask: ``(H, W)`` bool; None where only the box is known.
    """

    name: str
    box: tuple[float, float, float, float]
    mask: NDArray[np.bool_] | None = None

    @property
    def middle(self) -> tuple[float, float]:
        """x and y, pixels."""
        x0, y0, x1, y1 = self.box
        return (x0 + x1) / 2, (y0 + y1) / 2

    @property
    def size(self) -> float:
        """The square root of the box's area, pixels."""
        x0, y0, x1, y1 = self.box
        return ((x1 - x0) * (y1 - y0)) ** 0.5


class Cutout(NamedTuple):
    """An object cut out.

    Attributes:
        rgba: ``(h, w, 4)`` uint8, straight alpha; colour goes on beyond the object.
        direction: of its longer axis, radians; None where no axis is longer.
        contrast: how far its pixels are from the ground's light on average, in units of how far those around it are.
    """

    rgba: NDArray[np.uint8]
    direction: float | None
    contrast: float


def are_whole(objects: Sequence[Object], inside: Mapping[str, str], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """``(n,)`` which objects lie inside their photograph and are not covered by another one.

    Args:
        inside: see ``inside``; what an object lies on does not cover it.
        shape: height and width of the photograph.
    """
    covers = overlaps(objects)
    for i, one in enumerate(objects):
        for j, other in enumerate(objects):
            if inside.get(one.name) == other.name:
                covers[i, j] = 0
    boxes = np.array([one.box for one in objects]).reshape(-1, 4)
    framed = (boxes[:, :2] >= 1).all(1) & (boxes[:, 2:] <= np.array(shape[::-1]) - 1).all(1)
    return framed & (covers.max(1, initial=0.0) <= MAX_COVERED)


def cut_out(
    image: NDArray[np.uint8], objects: Sequence[Object], which: NDArray[np.bool_], light: float
) -> list[Cutout | None]:
    """Some of an image's objects, None for the others and for those that are too small.

    Args:
        image: ``(H, W, 3)``.
        which: ``(n,)`` those to cut out.
        light: the ground's, to which that around the object is brought.
    """
    each = [_around(one, image.shape[:2]) for one in objects]
    total = np.sum(each, 0, dtype=np.int16)
    return [
        _cut_out(image, one, total > own, light) if wanted else None
        for one, own, wanted in zip(objects, each, which, strict=True)
    ]


def covered(objects: Sequence[Object], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """``(H, W)`` where objects may be: a little around their masks, or around ellipses in their boxes."""
    there = np.zeros(shape, bool)
    for one in objects:
        there |= _around(one, shape) > 0
    return there


def overlaps(objects: Sequence[Object]) -> NDArray[np.float64]:
    """``(n, n)`` the share of each object's box that another one's covers; 0 for its own."""
    boxes = np.array([one.box for one in objects]).reshape(-1, 4)
    low, high = np.maximum(boxes[:, None, :2], boxes[None, :, :2]), np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    shares = np.clip(high - low, 0, None).prod(2) / np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(1), 1e-9)[:, None]
    np.fill_diagonal(shares, 0)
    return shares


def inside(photographs: Sequence[Sequence[Object]]) -> dict[str, str]:
    """By the names of classes, the class on whose objects theirs lie: nearly all of them with nearly all of their
    boxes, and on much larger ones. What something lies on lies on nothing itself."""
    names = sorted({one.name for objects in photographs for one in objects})
    size = {n: np.median([one.size for objects in photographs for one in objects if one.name == n]) for n in names}
    found: dict[str, str] = {}
    for name in sorted(names, key=lambda name: size[name]):
        for other in sorted(names, key=lambda name: size[name]):
            if size[other] < LARGER * size[name] or name in found.values() or other in found:
                continue
            each = [
                max((float(shares[j]) for j, under in enumerate(objects) if under.name == other), default=0.0)
                for objects in photographs
                for one, shares in zip(objects, overlaps(objects), strict=True)
                if one.name == name
            ]
            if len(each) >= MIN_INSIDE and np.mean(np.array(each) >= CONTAINED) >= MOSTLY:
                found[name] = other
                break
    return found


def parents(objects: Sequence[Object], relation: Mapping[str, str]) -> list[int | None]:
    """Of each object the one that it lies on, see ``inside``; None where it lies on none."""
    found: list[int | None] = []
    for one, shares in zip(objects, overlaps(objects), strict=True):
        of_class = [j for j, other in enumerate(objects) if other.name == relation.get(one.name)]
        best = max(of_class, key=lambda j: float(shares[j]), default=None)
        found.append(best if best is not None and shares[best] > 0 else None)
    return found


def turned(directions: Sequence[float | None]) -> bool:
    """Whether objects of a class lie in any direction: most have none, as they are round, or theirs differ."""
    known = np.array([each for each in directions if each is not None])
    if 2 * len(known) <= len(directions):
        return True
    return len(known) > 2 and bool(abs(np.exp(2j * known).mean()) < ALIGNED)


def _cut_out(image: NDArray[np.uint8], one: Object, others: NDArray[np.bool_], light: float) -> Cutout | None:
    """An object; ``others (H, W)`` is where others may be."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = one.box
    if min(x1 - x0, y1 - y0) < MIN_SIDE:
        return None
    left, top = max(int(x0) - MARGIN, 0), max(int(y0) - MARGIN, 0)
    right, bottom = min(int(np.ceil(x1)) + MARGIN, width), min(int(np.ceil(y1)) + MARGIN, height)
    patch = np.ascontiguousarray(image[top:bottom, left:right])
    box = (x0 - left, y0 - top, x1 - left, y1 - top)
    alpha = _separated(patch, box) if one.mask is None else one.mask[top:bottom, left:right].astype(np.float32)
    alpha = cv2.GaussianBlur(alpha, (0, 0), SMOOTH)
    ground = (alpha < 0.02) & ~others[top:bottom, left:right]
    gain, contrast = 1.0, np.inf
    if ground.sum() >= RING:
        middle = float(np.median(patch[ground]))
        gain = float(np.clip(light / max(middle, 1.0), 1 / MAX_GAIN, MAX_GAIN))
        off = np.abs(patch - middle).mean(2)
        contrast = float(off[alpha > 0.5].mean() / max(off[ground].mean(), 1.0)) if (alpha > 0.5).any() else 0.0
    colour = np.clip(patch * gain, 0, 255)
    rgba = np.rint(np.dstack([colour, 255 * alpha])).astype(np.uint8)
    return Cutout(rgba, _direction(alpha > 0.5), contrast)


def _separated(patch: NDArray[np.uint8], box: tuple[float, float, float, float]) -> NDArray[np.float32]:
    """``(h, w)`` 1 on the object in a patch."""
    height, width = patch.shape[:2]
    times = max(1, round(FINE / max(height, width)))
    large = cv2.resize(patch, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
    x0, y0 = (max(round(times * v), 1) for v in box[:2])
    x1, y1 = min(round(times * box[2]), times * width - 1), min(round(times * box[3]), times * height - 1)
    labels = np.full(large.shape[:2], cv2.GC_BGD, np.uint8)
    labels[y0:y1, x0:x1] = cv2.GC_PR_FGD
    ellipse = _ellipse(tuple(times * v for v in box), large.shape[:2], 1.0)
    found = ellipse
    if x1 - x0 >= 4 and y1 - y0 >= 4 and np.ptp(large) > 0:
        cv2.setRNGSeed(0)
        back, front = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(large, labels, (0, 0, 0, 0), back, front, ITERATIONS, cv2.GC_INIT_WITH_MASK)
        found = _largest(np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8))
        if found.sum() < MIN_FILLED * (x1 - x0) * (y1 - y0):
            found = ellipse
    small = cv2.resize(found.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return small.astype(np.float32)


def _largest(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The largest connected part, closed and without holes: a ring with a gap is a disc."""
    side = 2 * max(2, round(GAP * mask.any(0).sum())) + 1
    rim = side // 2
    framed = cv2.copyMakeBorder(mask, rim, rim, rim, rim, cv2.BORDER_CONSTANT)
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    closed = cv2.morphologyEx(framed, cv2.MORPH_CLOSE, shape)
    mask = closed[rim:-rim, rim:-rim].astype(np.uint8)
    number, label, stats, _ = cv2.connectedComponentsWithStats(mask)
    if number < 2:
        return mask
    largest = (label == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()).astype(np.uint8)
    outlines, _ = cv2.findContours(largest, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(largest, outlines, -1, 1, cv2.FILLED).astype(np.uint8)


def _around(one: Object, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """``(H, W)`` 1 on an object and close to it."""
    there = one.mask.astype(np.uint8) if one.mask is not None else _ellipse(one.box, shape, AROUND)
    return cv2.dilate(there, np.ones((5, 5), np.uint8)).astype(np.uint8)


def _ellipse(box: Sequence[float], shape: tuple[int, int], times: float) -> NDArray[np.uint8]:
    x0, y0, x1, y1 = box
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    across, down = max((x1 - x0) / 2, 0.5) * times, max((y1 - y0) / 2, 0.5) * times
    return ((((x - (x0 + x1) / 2) / across) ** 2 + ((y - (y0 + y1) / 2) / down) ** 2) <= 1).astype(np.uint8)


def _direction(mask: NDArray[np.bool_]) -> float | None:
    y, x = np.nonzero(mask)
    if len(x) < 3:
        return None
    values, vectors = np.linalg.eigh(np.cov(np.stack([x, y])) + 1e-6 * np.eye(2))
    if values[1] < AXIS_RATIO**2 * values[0]:
        return None
    return float(np.arctan2(vectors[1, 1], vectors[0, 1]))
