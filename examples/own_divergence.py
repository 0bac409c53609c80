"""A divergence of one's own: the energy distance, which needs no kernel's width.

    probscene fit examples/tabletop.py --target photos/ --out runs/own --divergence examples/own_divergence.py:energy

In Python, ``FitConfig(divergence=energy)``. Densities with a width that suits the features say more where
structures are many; distances say something wherever the features are.
"""

import torch
from torch import Tensor


def energy(generated: Tensor, real: Tensor) -> Tensor:
    """The cost ``(N,)`` of each scene with features ``(N, D)``, given those of real images ``(L, D)``.

    The energy distance (Székely, Rizzo 2013) of distributions q and p is ``2 E|x - y| - E|x - x'| - E|y - y'|`` for x,
    x' from q and y, y' from p: 0 where they agree, else positive. Its derivative by q at a scene x is the cost here,
    ``2 E|x - y| - 2 E|x - x'|``: low where real images are near and generated ones are not.

    It takes no gradient by the features; the score function needs one number a scene, so that good ones are told from
    bad ones.
    """
    others = torch.cdist(generated, generated).sum(1) / (len(generated) - 1)  # 0 to itself
    return 2 * (torch.cdist(generated, real).mean(1) - others)
