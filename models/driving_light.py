"""Sun, sky and camera of a driving scene, from what was drawn for them. Axis letters: N scenes."""

from collections.abc import Callable

import torch
from torch import Tensor

from probscene.world import Camera, Light, Photo

CLEAR = ((0.27, 0.47, 0.82), (0.80, 0.88, 0.96))  # zenith and horizon
OVERCAST = ((0.80, 0.82, 0.85), (0.92, 0.92, 0.92))
GRAINS = 2**31 - 1

Value = Callable[[str, str], Tensor]


def light(value: Value) -> Light:
    """Clouds dim the sun, whiten the sky and soften the contrast between light and shade.

    Args:
        value: of a kind's parameter, ``(N, 1)``.
    """
    cloud = value("weather", "cloud")
    zenith, horizon = (
        torch.lerp(torch.tensor(clear), torch.tensor(grey), cloud) for clear, grey in zip(CLEAR, OVERCAST, strict=True)
    )
    return Light(
        azimuth=value("sun", "azimuth"),
        elevation=value("sun", "elevation"),
        sun=1.0 - 0.9 * cloud,
        ambient=0.28 + 0.4 * cloud,
        zenith=zenith,
        horizon=horizon,
        haze=value("weather", "haze"),
    )


def camera(value: Value, canvas: tuple[int, int]) -> Camera:
    """KITTI's camera where the middle of its lane is y = 0."""
    pose = {name: value("camera", name) for name in ("yaw", "pitch", "roll")}
    return Camera.kitti(canvas, y=value("camera", "offset"), z=value("camera", "height"), **pose)


def photo(value: Value) -> Photo:
    """What the camera's electronics do."""
    numbers = {name: value("camera", name) for name in ("exposure", "contrast", "saturation", "noise")}
    return Photo(**numbers, seed=(value("camera", "grain").double() * GRAINS).long())
