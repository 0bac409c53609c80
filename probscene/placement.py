"""Where objects stand that do not overlap. Axis letters: N scenes, M nodes."""

import torch
from torch import Tensor

STEPS = 12


def separate(
    x: Tensor, y: Tensor, radius: Tensor | float, present: Tensor, canvas: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Push objects of a scene apart until their discs no longer overlap, as far as there is room: pairs that overlap
    part along the line between them, ``STEPS`` times, and stay on the canvas.

    Args:
        x, y: their middles ``(N, M)``, pixels.
        radius: of their discs, broadcast to ``(N, M)``, pixels.
        present: ``(N, M)`` bool, which of them there are.
        canvas: height and width, pixels.

    Returns:
        x and y ``(N, M)``; those of objects that are not present stay as they are.
    """
    present = present.expand(x.shape)
    reach = torch.as_tensor(radius, dtype=x.dtype).expand(x.shape).unsqueeze(2)
    nearest = reach + reach.mT  # (N, M, M)
    pair = present.unsqueeze(2) & present.unsqueeze(1)
    pair = pair & ~torch.eye(x.shape[1], dtype=torch.bool)
    inside = present.unsqueeze(-1)
    at = torch.stack([x, y], -1)
    order = torch.arange(x.shape[1])
    nudge = 1e-3 * (order.unsqueeze(1) - order).sign().to(x.dtype).unsqueeze(-1)  # those at one place part, too
    start, most = at, torch.tensor([canvas[1], canvas[0]], dtype=x.dtype)
    for _ in range(STEPS):
        away = at.unsqueeze(2) - at.unsqueeze(1) + nudge
        apart = away.norm(dim=-1).clamp(min=1e-3)
        push = ((nearest - apart) / 2).clamp(min=0).where(pair, 0.0)
        at = at + (push / apart).unsqueeze(-1).mul(away).sum(2)
        at = torch.minimum(at.clamp(min=0), most)
    x, y = at.where(inside, start).unbind(-1)
    return x, y
