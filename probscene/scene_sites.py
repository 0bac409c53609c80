"""Sites of whole scenes that a ``SceneGraph`` draws for a program. Axis letter: N scenes."""

from typing import Any

import pyro
import pyro.distributions as dist
from torch import Tensor

from .errors import ModelError

SEEDS = 2**31 - 1


def scene_site(name: str, num_scenes: int, prior: Any, call: str, **more: Any) -> Tensor:
    """One value a scene, ``(N, 1)``.

    Args:
        call: what the program has called for it, in words.
        more: of ``pyro.sample``.

    Raises:
        ModelError: the site's shape is another, as within a plate of nodes.
    """
    value = pyro.sample(name, prior, **more)
    if tuple(value.shape) != (num_scenes, 1):
        raise ModelError(
            f"expected site {name!r} with one value a scene, shape ({num_scenes}, 1), got {tuple(value.shape)}; "
            f"call {call} inside the plate 'scenes' and outside scene.nodes(...)."
        )
    return value


def seed_site(name: str, num_scenes: int, call: str) -> Tensor:
    """``(N, 1)`` int64, a seed for each scene, 0 to 2**31 - 2; the site keeps its prior. See ``scene_site``."""
    share = scene_site(name, num_scenes, dist.Uniform(0.0, 1.0), call, infer={"learn": False})
    return (share.double() * SEEDS).long().clamp(max=SEEDS - 1)
