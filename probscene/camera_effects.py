"""Camera effects on an image, in 2D and in 3D: their values, the limits of these, and the sites they are drawn at.

Axis letter: N scenes.
"""

from dataclasses import dataclass, fields
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor

from .errors import ModelError
from .scene_sites import scene_site, seed_site

MAX_BLUR = 64.0  # pixels
CALL = "scene.photo(...)"

EffectValue = Tensor | float | tuple[float, float] | dist.Distribution
"""A value, ``(N, 1)`` or a number; or its prior: the two ends of a uniform one, or a distribution."""


@dataclass(frozen=True, eq=False)
class CameraEffects:
    """Camera effects on an image; all are numbers or broadcast to ``(N, 1)``. The defaults leave every byte as it is;
    labels, and depth in 3D, never change.

    The effects are applied in this order: vignette, exposure, gains, saturation and contrast, on sRGB in 0..1; blur;
    noise; JPEG. Each reads and writes bytes, but colours and noise without a blur between them are rounded once.

    Args:
        exposure: factor of all light, 1 for as it is.
        contrast: around the middle grey 0.5, 1 for as it is.
        saturation: 0 for grey, 1 for as it is; grey pixels stay as they are.
        red_gain, blue_gain: white balance, factors of red and of blue; that of green is the exposure's.
        vignette: share of the light that is missing in the image's corners, 0..1; it grows with the square of the
            distance from the middle.
        blur: standard deviation of a Gaussian, pixels, 0..64; the image's border is continued outward.
        noise: standard deviation, of 255, in each channel of each pixel for itself.
        jpeg_quality: 1..100, as of libjpeg, rounded; infinity for no JPEG. Colour is kept at half of the resolution.
        seed: of each image's noise, ``(N, 1)`` int64, or a number.
    """

    exposure: Tensor | float = 1.0
    contrast: Tensor | float = 1.0
    saturation: Tensor | float = 1.0
    red_gain: Tensor | float = 1.0
    blue_gain: Tensor | float = 1.0
    vignette: Tensor | float = 0.0
    blur: Tensor | float = 0.0
    noise: Tensor | float = 0.0
    jpeg_quality: Tensor | float = torch.inf
    seed: Tensor | int = 0


LIMITS = {field.name: (0.0, torch.inf) for field in fields(CameraEffects) if field.name != "seed"} | {
    "vignette": (0.0, 1.0),
    "blur": (0.0, MAX_BLUR),
    "jpeg_quality": (1.0, 100.0),
}


def check_camera_effects(values: dict[str, Tensor]) -> None:
    """Check that the values of ``CameraEffects`` are within ``LIMITS``.

    Raises:
        ModelError: one is not.
    """
    for name, (low, high) in LIMITS.items():
        value = values[name]
        if name == "jpeg_quality":
            value = value[value != torch.inf]
        if not ((value >= low) & (value <= high)).all():  # also where it is NaN
            worst = value[~((value >= low) & (value <= high))][0]
            raise ModelError(
                f"expected CameraEffects.{name} {_within(name)}, got {float(worst):g}; give scene.photo(...) a range "
                "or a distribution that stays there."
            )


def sample_camera_effects(num_scenes: int, given: dict[str, EffectValue | None]) -> CameraEffects:
    """``CameraEffects`` whose values are sites ``photo.exposure`` and so on, one value a scene.

    Args:
        given: values and priors by name; those that are None keep the default and have no site.

    Raises:
        ModelError: something that is no range or not within the limits, or a site whose shape is not ``(N, 1)``.
    """
    values: dict[str, Any] = {}
    for name in LIMITS:  # the program's order of sites does not depend on the caller's
        value = given.get(name)
        if isinstance(value, tuple | list | dist.Distribution):
            prior = value if isinstance(value, dist.Distribution) else _uniform(name, value)
            values[name] = scene_site(f"photo.{name}", num_scenes, prior, CALL)
        elif value is not None:
            values[name] = value
    if "noise" in values:
        values["seed"] = seed_site("photo.seed", num_scenes, CALL)
    return CameraEffects(**values)


def _uniform(name: str, ends: tuple[float, float] | list[float]) -> Any:
    low, high = LIMITS[name]
    try:
        first, last = (float(end) for end in ends)
    except (TypeError, ValueError):
        first = last = torch.nan
    if not (low <= first < last <= high and last < torch.inf):
        raise ModelError(
            f"expected {name} of scene.photo(...) as a range (lowest, highest) {_within(name)}, got {ends!r}; write "
            "one number for a value that is the same in all images."
        )
    return dist.Uniform(first, last)


def _within(name: str) -> str:
    low, high = LIMITS[name]
    bounds = f"of at least {low:g}" if high == torch.inf else f"within {low:g}..{high:g}"
    return f"{bounds}, or infinity for no JPEG" if name == "jpeg_quality" else bounds
