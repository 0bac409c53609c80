"""Drawings of sprites to labelled images, on the CPU.

A pixel's centre is mapped back into the sprite, whose premultiplied texels are filtered bilinearly; beyond the sprite
everything is clear. A sprite drawn smaller than it is comes from a box-filtered level, its texels over half a pixel and
at most one, chosen for x and y apart; one drawn larger keeps edges one pixel wide. Sprites are blended in painter's
order into 8-bit channels. A node's id is written where its sprite's own alpha is at least one half; a sprite without a
label erases ids there. At angle 0 and scale 1, with texels on pixels, an opaque sprite's bytes appear unchanged.

A drawing's ``CameraEffects`` then changes the images, and nothing else.
"""

import numpy as np
import torch

from probscene.batch import RenderBatch
from probscene.drawing import Drawing
from probscene.errors import ModelError
from probscene.request import Renderable

from .. import engine
from ..camera.effects import EffectsProcessor
from . import kernel
from .instances import Instances, instances
from .sheet import Sheet

_MAX_CANVAS = 1 << 26
_CHUNK = 1 << 28  # pixels of one launch; the kernel's offsets are 32-bit


class SpriteRenderer:
    """A ``Renderer`` of sprites: ``SpriteRenderer((256, 256))(drawing)``.

    The same drawing gives the same bytes for any number of threads and however it is split into batches. Besides what
    it returns, a call needs about a kilobyte a sprite, and keeps up to 256 MiB of texels for the next.

    Args:
        canvas: height and width of the images, pixels.
        threads: how many threads render, by default one for every core that the process may use.

    Raises:
        ModelError: a canvas that is empty or of more than 2**26 pixels, or fewer than one thread.
    """

    def __init__(self, canvas: tuple[int, int], threads: int | None = None):
        self.canvas, self.threads = engine.check_canvas(canvas, threads, _MAX_CANVAS)
        self._sheet, self._finish = Sheet(), EffectsProcessor(self.canvas, self.threads)

    def __call__(self, drawing: Renderable) -> RenderBatch:
        """Render every scene of a drawing.

        Where several labelled layers draw a node, its silhouette's pixels are the sum over these layers.

        Raises:
            ModelError: it is a world; the drawing holds what cannot be drawn, see ``instances``.
            ProbsceneError: in a process forked from one in which the engine ran.
        """
        return self._rendered(drawing, True)

    def labels(self, drawing: Renderable) -> RenderBatch:
        """A drawing's labels alone, in less time: the batch that rendering gives, but for ``image (N, 3, H, W)``, which
        is black.

        Raises:
            ModelError, ProbsceneError: as rendering does, but for what is wrong with the drawing's photo.
        """
        return self._rendered(drawing, False)

    def _rendered(self, drawing: Renderable, coloured: bool) -> RenderBatch:
        if not isinstance(drawing, Drawing):
            raise ModelError(f"expected a Drawing of sprites, got a {type(drawing).__name__}; take MeshRenderer.")
        engine.start()
        height, width = self.canvas
        scenes, nodes = drawing.kind.shape
        table = instances(drawing, self._sheet, self.canvas, coloured)
        first = np.searchsorted(table.scene, np.arange(scenes + 1)).astype(np.int32)
        pixels = scenes * height * width
        image = self._background(drawing, scenes) if coloured else self._black(scenes)
        instance = np.zeros(_even(pixels), np.int16)
        result = np.zeros((max(1, scenes), max(1, nodes), kernel.RESULTS), np.int64)
        step = _even(max(1, _CHUNK // (height * width) - 3))
        for start in range(0, scenes, step):
            stop = min(start + step, scenes)
            part = slice(start * height * width, _even(stop * height * width))
            rgb, ids = image[3 * part.start : 3 * part.stop], instance[part]
            kernel.paint(
                min(self.threads, stop - start), stop - start, height, width, nodes, coloured,
                np.zeros(1, np.int32), first[start : stop + 1].copy(), table.whole, table.real, self._sheet.texels,
                self._sheet.colours, rgb, rgb.view(np.uint32), ids, ids.view(np.int64), result[start:stop].reshape(-1),
            )  # fmt: skip
        if coloured and drawing.photo is not None:
            self._finish(drawing.photo, image, scenes, toned=False)
        return _batch(
            drawing,
            table,
            torch.from_numpy(image[: 3 * pixels].reshape(scenes, height, width, 3)),
            torch.from_numpy(instance[:pixels].reshape(scenes, height, width)),
            torch.from_numpy(result[:scenes, :nodes]),
        )

    def _black(self, scenes: int) -> np.ndarray:
        """Images, flat; they cost nothing until they are touched."""
        return np.zeros(3 * _even(scenes * self.canvas[0] * self.canvas[1]), np.uint8)

    def _background(self, drawing: Drawing, scenes: int) -> np.ndarray:
        """Images before anything is drawn, flat."""
        (height, width), image = self.canvas, self._black(scenes)
        colour = np.rint(np.clip(np.asarray(drawing.background, np.float64), 0, 1) * 255).astype(np.uint8)
        if colour.any():
            empty = np.tile(colour, height * width)
            image[: scenes * empty.size].reshape(scenes, empty.size)[:] = empty
        return image


def _even(count: int) -> int:
    """The next multiple of four: the kernel reads and writes four pixels at once."""
    return -(-count // 4) * 4


def _batch(drawing: Drawing, table: Instances, image, instance, result) -> RenderBatch:
    drawn = np.zeros(tuple(drawing.kind.shape), bool)
    drawn[table.scene[table.labelled], table.node[table.labelled]] = True
    whole, seen = result[..., kernel.WHOLE_PIXELS], result[..., kernel.SEEN_PIXELS]
    return RenderBatch(
        image=image.permute(0, 3, 1, 2),
        instance=instance,
        kind=torch.where(torch.from_numpy(drawn), drawing.kind.cpu(), -1),
        box=result[..., kernel.SEEN : kernel.SEEN + 4].float(),
        amodal_box=result[..., kernel.WHOLE : kernel.WHOLE + 4].float(),
        pixels=seen.clone(),
        visible=torch.where(whole > 0, seen / whole.clamp(min=1), 0.0).float(),
    )
