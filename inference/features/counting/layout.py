"""Where the objects of an image stand, as features: the map of what a network counts in each cell, at several scales.

A map is divided by its number of objects, so that it says where an object of the image is likely to be. It is then
averaged over squares of 1, 2, 4, ... cells, each scale weighted by the side of its squares: the city block distance of
two such vectors is, up to a factor, the earth mover's distance of the two maps [1], how far objects have to be moved to
get from the one layout to the other. Axis letters: N images, C classes, h w cells.

Reference:
    [1] Indyk, Thaper, *Fast image retrieval via embeddings*, SCTV 2003.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

LEAST = 0.5  # objects in an image that has a layout


def scales(cells: Tensor) -> Tensor:
    """``(N, D)`` of maps ``(N, h, w)`` of expected numbers, in units of a cell's side; of an empty map zeros."""
    mass = cells.sum((1, 2), keepdim=True)
    x = torch.where(mass > 0, cells / mass.clamp(min=1e-9), 0.0).unsqueeze(1)
    parts, side = [x.flatten(1)], 1
    while max(x.shape[2:]) > 1:
        x = F.avg_pool2d(F.pad(x, (0, x.shape[3] % 2, 0, x.shape[2] % 2)), 2) * 4
        side *= 2
        parts.append(side * x.flatten(1))
    return torch.cat(parts, 1)


def objects(cells: Tensor) -> Tensor:
    """``(N,)`` how many objects maps ``(N, h, w)`` hold."""
    return cells.sum((1, 2))
