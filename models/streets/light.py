"""Sun, sky and camera of a driving scene, from what was drawn for them. Axis letters: N scenes."""

from collections.abc import Callable

import torch
from torch import Tensor

from probscene.camera_effects import CameraEffects
from probscene.world import Camera, Light

# Zenith and horizon. A camera that exposes for the road shows a sky that is nearly white.
CLEAR = ((0.42, 0.62, 0.94), (0.93, 0.97, 1.0))
OVERCAST = ((0.94, 0.95, 0.97), (1.0, 1.0, 1.0))
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
        sun=1.1 - 1.0 * cloud,
        ambient=0.44 + 0.32 * cloud,
        zenith=zenith,
        horizon=horizon,
        haze=value("weather", "haze"),
    )


def camera(value: Value, canvas: tuple[int, int]) -> Camera:
    """KITTI's camera where the middle of its lane is y = 0."""
    pose = {name: value("camera", name) for name in ("yaw", "pitch", "roll")}
    return Camera.kitti(canvas, y=value("camera", "offset"), z=value("camera", "height"), **pose)


def photo(value: Value) -> CameraEffects:
    """What the camera's electronics do."""
    numbers = {name: value("camera", name) for name in ("exposure", "contrast", "saturation", "noise")}
    return CameraEffects(**numbers, seed=(value("camera", "grain").double() * GRAINS).long())
