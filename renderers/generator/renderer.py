"""The renderer of a model that has a generator: a ``Request`` goes out, images and ids come back.

Axis letters: N scenes, M nodes, H W of the canvas.
"""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.ndimage import find_objects
from torch import Tensor

from probscene.batch import RenderBatch
from probscene.errors import ModelError
from probscene.generator import Command, Generator
from probscene.program_errors import user_errors
from probscene.request import Renderable, Request
from probscene.threads import cores
from probscene.worker import packed, scene_of

from ..camera.effects import apply_camera_effects
from .pool import pool_for
from .reply import Fault, Picture, parse_reply


class GeneratedRenderer:
    """Draws requests with a model's generator.

    What only a generator's ids do not tell, amodal boxes and visible shares, is ``unknown`` in the batch.

    Args:
        generator: see ``SceneModel.generator``.
        canvas: height and width of the images, pixels.
        threads: how many scenes are drawn at once by a ``Command`` that does not say; one for each core where None.
    """

    def __init__(self, generator: Generator, canvas: tuple[int, int], threads: int | None = None):
        self.generator, self.canvas, self.threads = generator, canvas, threads or cores()
        self._alone = threading.Lock()

    def __call__(self, drawing: Renderable) -> RenderBatch:
        """Draw every scene.

        Raises:
            ModelError: the program returned no request, or a generator in this process failed.
            GeneratorError: a command failed, see ``Pool.draw``.
        """
        if not isinstance(drawing, Request):
            raise ModelError(
                f"expected the program of a model with a generator to return scene.request(...), got "
                f"{type(drawing).__name__}; or take generator= away."
            )
        records = drawing.records(self.canvas)
        if isinstance(self.generator, Command):
            pictures = pool_for(self.generator, self.threads).draw(records)
        else:
            with self._alone, user_errors("the generator", self.generator):
                pictures = [_drawn_here(self.generator, record) for record in records]
        batch = _batch(drawing, pictures, self.canvas)
        if drawing.photo is None or not len(drawing):
            return batch
        return batch._replace(image=apply_camera_effects(drawing.photo, batch.image, self.threads))


def _drawn_here(generator: Callable[[Any], Any], record: dict[str, Any]) -> Picture:
    drawn = generator(scene_of(record))
    try:
        reply, arrays = packed(drawn)
        return parse_reply(record, reply, b"".join(arrays))
    except (Fault, ValueError) as error:
        raise ModelError(f"expected a picture of the generator, got another answer: {error}.") from error


def _batch(request: Request, pictures: list[Picture], canvas: tuple[int, int]) -> RenderBatch:
    (N, M), (H, W) = request.kind.shape, canvas
    image, instance = np.zeros((N, H, W, 3), np.uint8), np.zeros((N, H, W), np.int16)
    box, whole = np.zeros((N, M, 4), np.float32), np.zeros((N, M, 4), np.float32)
    pixels = np.zeros((N, M), np.int64)
    for i, picture in enumerate(pictures):
        image[i], instance[i] = picture.image, picture.instance
        pixels[i] = np.bincount(picture.instance.ravel(), minlength=M + 1)[1:]
        for node, found in enumerate(find_objects(picture.instance)):
            if found is not None:
                rows, columns = found
                box[i, node] = columns.start, rows.start, columns.stop, rows.stop
        if picture.amodal_box is not None:
            whole[i, : len(picture.amodal_box)] = picture.amodal_box
    boxed = _all_or_none("amodal_box", [picture.amodal_box for picture in pictures])
    deep = _all_or_none("depth", [picture.depth for picture in pictures])
    return RenderBatch(
        torch.from_numpy(image).permute(0, 3, 1, 2),
        torch.from_numpy(instance),
        request.kind,
        torch.from_numpy(box),
        torch.from_numpy(whole if boxed else box.copy()),
        torch.from_numpy(pixels),
        torch.from_numpy((pixels > 0).astype(np.float32)),
        unknown=("visible",) if boxed else ("amodal_box", "visible"),
        depth=_stacked([picture.depth for picture in pictures]) if deep else None,
    )


def _all_or_none(name: str, given: list[np.ndarray | None]) -> bool:
    known = sum(value is not None for value in given)
    if 0 < known < len(given):
        raise ModelError(
            f"expected {name} from the generator for all scenes or for none, got for {known} of {len(given)}; give "
            "it for all."
        )
    return known > 0


def _stacked(parts: list[np.ndarray | None]) -> Tensor:
    return torch.from_numpy(np.stack([part for part in parts if part is not None]).astype(np.float32))
