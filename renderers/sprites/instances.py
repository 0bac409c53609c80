"""A drawing as the sprite kernel's instance table: one row a sprite, vectorised over the batch.

Everything is float64 arithmetic on the numbers of that row alone, put into fixed point at the end, so that a scene's
row does not depend on its batch.
"""

from typing import NamedTuple

import numpy as np
import torch

from probscene.drawing import Drawing
from probscene.errors import ModelError

from . import kernel
from .sheet import LEVELS, Sheet, Variant

MAX_NODES = 32767
MAX_CANVASES = 64
MAX_POSITION = 1 << 24

_REAL = ("x", "y", "angle", "scale_x", "scale_y", "tint")
_FILTER = 2.0**-9  # added to positions, so that dropping bits rounds to the filter's 1/256 of a texel
_FRAME = 1 + _FILTER  # the position of the first texel's centre
_MARGIN = 2.0**-20  # of a texel: over the error of a span's end, under what the filter sees


class Instances(NamedTuple):
    """Sprites in the order of scene, layer, node. I instances.

    ``scene, node (I,)`` int64; ``labelled (I,)`` bool; ``whole`` and ``real`` are the kernel's tables, flat, of at
    least one row.
    """

    scene: np.ndarray
    node: np.ndarray
    labelled: np.ndarray
    whole: np.ndarray
    real: np.ndarray


def instances(drawing: Drawing, sheet: Sheet, canvas: tuple[int, int], coloured: bool = True) -> Instances:
    """Build the table, and check all that the kernel relies on.

    Args:
        coloured: see ``kernel.paint``; without colours a sprite counts as opaque where it hides what is below.

    Raises:
        ModelError: more than 32767 nodes, layers of another shape than the drawing, a value that is not finite, a scale
            that is not positive, a sprite outside its atlas, more than 2**24 pixels away, or of more than 64 canvases.
    """
    shape = tuple(drawing.kind.shape)
    if shape[1] > MAX_NODES:
        raise ModelError(f"expected at most {MAX_NODES} nodes a scene, got {shape[1]}; draw fewer things.")
    for i, layer in enumerate(drawing.layers):
        for name, value in vars(layer).items():
            expected = shape if layer.labelled else tuple(layer.present.shape)
            if isinstance(value, torch.Tensor) and tuple(value.shape[:2]) != expected:
                raise ModelError(
                    f"expected {name} of layer {i} as (scenes, nodes) = {expected}, got {tuple(value.shape)}; "
                    "make layers with probscene.drawing.resolve."
                )
    present = _joined(drawing, "present")
    scene, column = np.nonzero(present)
    layer, node = _columns(drawing)[:, column]
    values = {name: _joined(drawing, name)[present] for name in ("sprite", *_REAL)}
    _check(values)
    labelled = np.array([layer.labelled for layer in drawing.layers], bool)[layer]
    rows = max(1, len(scene))  # the engine takes no empty array
    whole, real = np.zeros((rows, kernel.INTEGERS), np.int64), np.zeros((rows, kernel.REALS))
    if len(scene):
        whole[:, kernel.NODE] = np.where(labelled, node, -1)
        _fill(whole, real, values, layer, drawing, sheet, canvas, coloured)
    return Instances(scene, node, labelled, whole.ravel(), real.ravel())


def _joined(drawing: Drawing, name: str) -> np.ndarray:
    """One attribute of all layers side by side, ``(N, columns, ...)``."""
    layers = [getattr(layer, name).detach().cpu().numpy() for layer in drawing.layers]
    return np.concatenate(layers, 1) if layers else np.zeros((len(drawing), 0), bool)


def _columns(drawing: Drawing) -> np.ndarray:
    """``(2, columns)`` the layer, and the place in it, of every column of ``_joined``."""
    widths = [layer.present.shape[1] for layer in drawing.layers]
    places = [np.stack([np.full(width, i), np.arange(width)]) for i, width in enumerate(widths)]
    return np.concatenate(places, 1) if places else np.zeros((2, 0), np.int64)


def _check(values: dict[str, np.ndarray]) -> None:
    for name in _REAL:
        if not np.isfinite(values[name]).all():
            raise ModelError(f"expected finite {name} in a drawing, got NaN or infinity; check the program.")
    for name in ("x", "y"):
        if (np.abs(values[name]) > MAX_POSITION).any():
            raise ModelError(
                f"expected {name} within {MAX_POSITION} pixels, got {np.abs(values[name]).max():g} away; "
                "check the program's units."
            )
    for name in ("scale_x", "scale_y"):
        if (values[name] <= 0).any():
            raise ModelError(
                f"expected a positive {name} in a drawing, got {values[name].min():g}; "
                "draw scales, widths and radii above 0."
            )


def _level(scale: np.ndarray) -> np.ndarray:
    """The level at which a texel is over half a pixel and at most one; 0 for magnification."""
    fraction, exponent = np.frexp(scale)
    return np.clip((fraction == 0.5) - exponent.astype(np.int64), 0, LEVELS - 1)


def _fill(whole, real, values, layer, drawing, sheet, canvas, coloured) -> None:
    """Write the tables; arrays are ``(I,)``, or ``(I, 2)`` for x and y."""
    x, y, angle = (values[name].astype(np.float64) for name in ("x", "y", "angle"))
    scale = np.stack([values["scale_x"], values["scale_y"]], 1).astype(np.float64)
    level = _level(scale)
    cell = np.ldexp(1.0, level)
    texel = np.maximum(scale * cell, 0.25)  # pixels; what is yet smaller has faded away
    variant, size = _variants(values["sprite"], level, (texel > 1).any(1), layer, drawing, sheet)
    wide = np.stack([variant.width, variant.height], 1).astype(np.float64)
    inset = (variant.inset if coloured else variant.solid)[:, None]
    hard = ((variant.touches != 0) & (texel > 1).any(1))[:, None]

    # Positions at which the sprite may be seen and at which it is opaque. An edge is cut over one pixel, or over the
    # texel where that is wider, and then the clear frame does it.
    reach = 0.5 / np.maximum(texel, 1)
    start, end = np.full_like(wide, _FRAME - 0.5), _FRAME - 0.5 + wide
    low = np.where(hard, start - reach, 0) + _MARGIN
    high = np.minimum(np.where(hard, end + reach, np.inf), wide + 1) - _MARGIN
    at_edge = hard & (inset == 0)
    low_in = np.where(at_edge, start + reach, inset + 1) + _MARGIN
    high_in = np.where(at_edge, end - reach, wide - inset + 2 * _FILTER) - _MARGIN

    # The bounding box: what may be seen, from the sprite's centre, turned onto the canvas.
    trimmed = np.stack([variant.left, variant.top], 1) + 0.5 - _FRAME
    near, far = ((position + trimmed) * texel - size * scale / 2 for position in (low, high))
    middle, half = (near + far) / 2, (far - near) / 2
    cos, sin = np.cos(angle), np.sin(angle)
    middle_x, middle_y = x + cos * middle[:, 0] + sin * middle[:, 1], y - sin * middle[:, 0] + cos * middle[:, 1]
    half_x = np.abs(cos) * half[:, 0] + np.abs(sin) * half[:, 1]
    half_y = np.abs(sin) * half[:, 0] + np.abs(cos) * half[:, 1]
    most = MAX_CANVASES * max(canvas[0] * canvas[1], 4096)
    too_large = (4 * half_x * half_y > most) | (np.maximum(half_x, half_y) > MAX_POSITION)
    if too_large.any():
        worst = int(too_large.argmax())
        raise ModelError(
            f"expected sprites whose boxes cover at most {most} pixels, {MAX_CANVASES} canvases, "
            f"got one of {2 * half_x[worst]:.4g} by {2 * half_y[worst]:.4g} pixels; bound the scale."
        )
    x0, y0 = np.floor(middle_x - half_x - 0.5), np.floor(middle_y - half_y - 0.5)
    x1, y1 = np.ceil(middle_x + half_x + 0.5), np.ceil(middle_y + half_y + 0.5)
    y1 = np.where((wide.min(1) > 0) & (coloured | (variant.faint == 0)), y1, y0)

    step_x = np.stack([cos, sin], 1) / texel
    step_y = np.stack([-sin, cos], 1) / texel
    first = step_x * (x0 + 0.5 - x)[:, None] + step_y * (y0 + 0.5 - y)[:, None] + size / 2 / cell - trimmed
    whole[:, [kernel.X0, kernel.Y0, kernel.X1, kernel.Y1]] = np.stack([x0, y0, x1, y1], 1)
    whole[:, [kernel.U, kernel.V]] = np.rint(first * kernel.ONE)
    whole[:, [kernel.U_DX, kernel.V_DX]] = np.rint(step_x * kernel.ONE)
    whole[:, [kernel.U_DY, kernel.V_DY]] = np.rint(step_y * kernel.ONE)
    whole[:, kernel.TEXEL], whole[:, kernel.STRIDE] = variant.offset, variant.width + 2
    whole[:, [kernel.RED, kernel.GREEN, kernel.BLUE]] = np.rint(np.clip(values["tint"], 0, 1) * 256)
    whole[:, kernel.HARD], whole[:, kernel.EVEN] = hard[:, 0], variant.even
    ranges = np.concatenate([low, high, low_in, high_in, start, end], 1)
    real[:, kernel.U_LO : kernel.V_END + 1] = ranges * kernel.ONE
    real[:, [kernel.U_SHARP, kernel.V_SHARP]] = np.maximum(texel, 1) / kernel.ONE
    per_position = real[:, kernel.PER_U : kernel.PER_V + 1]
    steps = whole[:, kernel.U_DX : kernel.V_DX + 1].astype(np.float64)
    np.divide(1.0, steps, out=per_position, where=steps != 0)


def _variants(sprite, level, magnified, layer, drawing, sheet) -> tuple[Variant[np.ndarray], np.ndarray]:
    """Every instance's variant, as arrays ``(I,)``, and its sprite's width and height ``(I, 2)``."""
    found = np.zeros((len(layer), len(Variant._fields)), np.int64)
    size = np.zeros((len(layer), 2), np.float64)
    sheet.trim()
    for i in np.unique(layer).tolist():
        atlas, mine = drawing.layers[i].atlas, layer == i
        index = sprite[mine].astype(np.int64)
        if index.min() < 0 or index.max() >= len(atlas):
            raise ModelError(
                f"expected sprites of layer {i} in 0..{len(atlas) - 1}, got {index.min()}..{index.max()}; "
                "choose sprites that its atlas has."
            )
        found[mine] = sheet.find(atlas, index, level[mine], magnified[mine].astype(np.int64))
        size[mine] = sheet.sizes(atlas)[index]
    return Variant(*found.T), size
