"""The sprite renderer's slow twin, in plain numpy: what ``SpriteRenderer`` must agree with.

One sprite at a time, every pixel of its bounding box, one formula for all sizes: the texels' colours, continued beyond
the sprite's edges, times how much of the filter's footprint the edges leave. At one texel a pixel and below that is
bilinear filtering with a clear border. It checks nothing, and shares no line with the renderer.
"""

from typing import NamedTuple

import numpy as np
import torch

from probscene.batch import RenderBatch
from probscene.drawing import Drawing, Layer


class Spread(NamedTuple):
    """A sprite on the pixels from (x0, y0): ``colour (h, w, 3)`` premultiplied and ``alpha (h, w)``, 0..255."""

    x0: int
    y0: int
    colour: np.ndarray
    alpha: np.ndarray


class ReferenceRenderer:
    """The same call as ``SpriteRenderer``: ``ReferenceRenderer((256, 256))(drawing)``."""

    def __init__(self, canvas: tuple[int, int]):
        self.canvas = canvas

    def __call__(self, drawing: Drawing) -> RenderBatch:
        """Render every scene of a drawing."""
        (scenes, nodes), (height, width) = drawing.kind.shape, self.canvas
        background = np.rint(np.clip(drawing.background, 0, 1) * 255).astype(np.uint8)
        image = np.tile(background, (scenes, height, width, 1))
        instance = np.zeros((scenes, height, width), np.int16)
        kind = torch.full((scenes, nodes), -1)
        box, amodal_box = torch.zeros(scenes, nodes, 4), torch.zeros(scenes, nodes, 4)
        pixels, whole = torch.zeros(scenes, nodes, dtype=torch.int64), torch.zeros(scenes, nodes, dtype=torch.int64)
        for n in range(scenes):
            for layer in drawing.layers:
                for m in layer.present[n].nonzero().flatten().tolist():
                    drawn = spread(layer, n, m)
                    _blend(image[n], instance[n], drawn, m + 1 if layer.labelled else 0)
                    if layer.labelled:
                        kind[n, m] = drawing.kind[n, m]
                        silhouette = drawn.alpha >= 127.5
                        if silhouette.any():
                            extent = _extent(silhouette) + torch.tensor([drawn.x0, drawn.y0, drawn.x0, drawn.y0])
                            amodal_box[n, m] = _union(amodal_box[n, m], extent) if whole[n, m] else extent
                            whole[n, m] += int(silhouette.sum())
            for m in range(nodes):
                mask = instance[n] == m + 1
                pixels[n, m] = int(mask.sum())
                if mask.any():
                    box[n, m] = _extent(mask)
        return RenderBatch(
            image=torch.from_numpy(image).permute(0, 3, 1, 2),
            instance=torch.from_numpy(instance),
            kind=kind,
            box=box,
            amodal_box=amodal_box,
            pixels=pixels,
            visible=torch.where(whole > 0, pixels / whole.clamp(min=1), 0.0).float(),
        )


def spread(layer: Layer, n: int, m: int) -> Spread:
    """The sprite that a layer draws for node ``m`` of scene ``n``, on all pixels that it reaches."""
    sprite = layer.atlas.sprites[int(layer.sprite[n, m])]
    x, y, angle = float(layer.x[n, m]), float(layer.y[n, m]), float(layer.angle[n, m])
    scales = float(layer.scale_x[n, m]), float(layer.scale_y[n, m])
    height, width = sprite.shape[:2]

    texels = sprite.astype(np.float64)
    texels[..., :3] = np.rint(texels[..., :3] * texels[..., 3:] / 255)
    cells = [2 ** max(0, int(np.floor(np.log2(1 / scale)))) for scale in scales]
    texels = _box_filter(texels, cells[1], cells[0])

    radius = int(np.hypot((width + 2 * cells[0]) * scales[0], (height + 2 * cells[1]) * scales[1]) / 2) + 2
    x0, y0 = int(np.floor(x)) - radius, int(np.floor(y)) - radius
    dx = (x0 + np.arange(2 * radius + 1) + 0.5 - x)[None, :]
    dy = (y0 + np.arange(2 * radius + 1) + 0.5 - y)[:, None]
    across = np.cos(angle) * dx - np.sin(angle) * dy  # pixels along the sprite's own axes
    down = np.sin(angle) * dx + np.cos(angle) * dy
    u = (across / scales[0] + width / 2) / cells[0]  # texels from the sprite's left edge
    v = (down / scales[1] + height / 2) / cells[1]

    left = _left(u, texels.shape[1], scales[0] * cells[0]) * _left(v, texels.shape[0], scales[1] * cells[1])
    rgba = _bilinear(texels, u - 0.5, v - 0.5) * left[..., None]
    tint = np.clip(layer.tint[n, m].numpy().astype(np.float64), 0, 1)
    return Spread(x0, y0, rgba[..., :3] * tint, rgba[..., 3])


def _box_filter(texels, rows, columns):
    """Means over cells of ``rows`` by ``columns``, clear beyond the sprite, rounded to bytes."""
    height, width = texels.shape[:2]
    padded = np.pad(texels, ((0, -height % rows), (0, -width % columns), (0, 0)))
    cells = padded.reshape(padded.shape[0] // rows, rows, padded.shape[1] // columns, columns, 4)
    return np.rint(cells.mean((1, 3)))


def _left(position, end, texel):
    """What edges at 0 and ``end`` texels leave of a footprint one pixel wide, or a texel where that is wider."""
    sharp = max(1.0, texel)
    return np.clip(position * sharp + 0.5, 0, 1) * np.clip((end - position) * sharp + 0.5, 0, 1)


def _bilinear(texels, u, v):
    """At 1/256 of a texel, as the kernel's filter; the outermost texels go on for ever."""
    u, v = np.floor(u * 256 + 0.5) / 256, np.floor(v * 256 + 0.5) / 256
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    fv, fu = (v - i)[..., None], (u - j)[..., None]

    def at(rows, columns):
        return texels[np.clip(rows, 0, texels.shape[0] - 1), np.clip(columns, 0, texels.shape[1] - 1)]

    upper = at(i, j) * (1 - fu) + at(i, j + 1) * fu
    lower = at(i + 1, j) * (1 - fu) + at(i + 1, j + 1) * fu
    return upper * (1 - fv) + lower * fv


def _blend(image, instance, drawn, label):
    height, width = instance.shape
    size_y, size_x = drawn.alpha.shape
    top, bottom = max(0, drawn.y0), min(height, drawn.y0 + size_y)
    left, right = max(0, drawn.x0), min(width, drawn.x0 + size_x)
    if top >= bottom or left >= right:
        return
    part = slice(top - drawn.y0, bottom - drawn.y0), slice(left - drawn.x0, right - drawn.x0)
    colour, alpha = drawn.colour[part], drawn.alpha[part]
    under = image[top:bottom, left:right]
    under[:] = np.rint(colour + under * (1 - alpha[..., None] / 255))
    instance[top:bottom, left:right][alpha >= 127.5] = label


def _extent(mask):
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return torch.tensor([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], dtype=torch.float32)


def _union(a, b):
    return torch.cat([torch.minimum(a[:2], b[:2]), torch.maximum(a[2:], b[2:])])
