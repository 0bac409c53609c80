"""Objects counted by group and in order: every cell votes for the middle of the group that it belongs to.

As in Hough voting, and Panoptic-DeepLab's votes for instances [1], but along one axis: groups are the peaks of the
votes of all cells that show one, and an object belongs to the peak nearest to its own cell's vote. A vote needs no more
of the image than the group's surroundings, so what is learnt holds wherever a group is and however many there are. Axis
letters: N images, M nodes, C classes, G groups, P pixels along the axis, h w cells.

Reference:
    [1] Cheng et al., *Panoptic-DeepLab*, CVPR 2020.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

VOTE_SD = 2.0  # pixels, standard deviation of a vote
MIN_PEAK_SHARE = 0.25  # of an ordinary group's votes that a peak must have
ABSENT = -1.0  # the count of a group that is not there, so that it is none of those that are there and empty


def tally_groups(
    objects: Tensor, surface: Tensor, vote: Tensor, object_vote: Tensor, length: int, mass: float, max_groups: int
) -> Tensor:
    """How many groups, and the counts of each class in each of them, ``(N, 1 + C * max_groups)``.

    Args:
        objects: ``(N, C, h, w)`` how much of an object a cell holds.
        surface: ``(N, h, w)`` probability that a cell shows a group.
        vote: ``(N, h, w)`` where along the axis the middle of the group is that a cell shows, pixels.
        object_vote: ``(N, h, w)`` the same of the group that a cell's object belongs to.
        length: P, pixels along the axis.
        mass: cells of an ordinary group.
        max_groups: groups with counts of their own; objects of later ones are counted with the last.

    Returns:
        The number of groups, then C counts of the first group, of the second, ...: ``ABSENT`` where there is none.
    """
    N, C = objects.shape[:2]
    height = _density(vote.flatten(1).clamp(0, length - 1), surface.flatten(1), length)
    peak = height > MIN_PEAK_SHARE * mass / (VOTE_SD * (2 * torch.pi) ** 0.5)
    peak[:, 1:] &= height[:, 1:] > height[:, :-1]
    peak[:, :-1] &= height[:, :-1] >= height[:, 1:]
    number = peak.sum(1)
    away = (object_vote.flatten(1).unsqueeze(-1) - torch.arange(length, device=peak.device)).abs()
    away = away.masked_fill(~peak.unsqueeze(1), length)
    rank = (peak.cumsum(1) - 1).gather(1, away.argmin(-1)).clamp(0, max_groups - 1)  # of each cell's group
    counts = objects.new_zeros(N, max_groups, C)
    counts.scatter_add_(1, rank.unsqueeze(-1).expand(-1, -1, C), objects.flatten(2).transpose(1, 2))
    # Objects of no group go to the first.
    there = torch.arange(max_groups, device=number.device) < number.clamp(min=1).unsqueeze(1)
    counts = counts.where(there.unsqueeze(-1), ABSENT)
    return torch.cat([number.unsqueeze(1).float(), counts.flatten(1)], 1)


def _density(place: Tensor, weight: Tensor, length: int) -> Tensor:
    """Votes a pixel ``(N, P)``, smoothed."""
    low = place.floor().long()
    part = place - low
    votes = weight.new_zeros(len(place), length + 1)
    votes.scatter_add_(1, low, weight * (1 - part))
    votes.scatter_add_(1, low + 1, weight * part)
    reach = int(4 * VOTE_SD)
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=votes.device) / VOTE_SD) ** 2)
    return F.conv1d(votes[:, None, :length], (kernel / kernel.sum())[None, None], padding=reach)[:, 0]
