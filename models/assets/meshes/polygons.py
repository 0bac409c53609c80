"""Polygons of more than three corners: trimesh fills each with a fan of triangles from its first corner."""

from collections.abc import Sequence

import numpy as np

_FLAT = 1e-3  # of a polygon's area, by which a triangle of its fan may be turned over: rounding


Polygons = Sequence[Sequence[int]] | np.ndarray


def unfillable(positions: np.ndarray, polygons: Polygons) -> int | None:
    """The number of the first polygon that its fan does not fill, such as one with a dent; None where all are filled.

    A fan fills a polygon of which the first corner sees all of it, every convex one therefore.

    Args:
        positions: ``(V, 3)``.
        polygons: vertices of each. One that is not there, or not finite, is no fault of the polygon.
    """
    finite = np.asarray(np.isfinite(positions).all(1)).tolist()
    of_length: dict[int, list[int]] = {}
    for number, polygon in enumerate(polygons):
        if len(polygon) > 3 and all(0 <= vertex < len(finite) and finite[vertex] for vertex in polygon):
            of_length.setdefault(len(polygon), []).append(number)
    found = []
    for numbers in of_length.values():
        corners = positions[np.array([polygons[number] for number in numbers], int)]  # (P, n, 3)
        spokes = corners[:, 1:] - corners[:, :1]
        areas = np.cross(spokes[:, :-1], spokes[:, 1:])  # (P, n - 2, 3) twice that of each triangle, along its normal
        whole = areas.sum(1)
        turned = np.einsum("pti,pi->pt", areas, whole) < -_FLAT * (whole**2).sum(-1, keepdims=True)
        found += [numbers[at] for at in np.flatnonzero(turned.any(1))[:1]]
    return min(found, default=None)
