"""A detector's training data straight from the grammar: an iterable torch dataset that draws, renders and labels.

    dataset = SceneDataset("runs/one", num=10_000, batch_size=8)
    loader = DataLoader(dataset, batch_size=8, collate_fn=SceneDataset.collate,
                        num_workers=2, multiprocessing_context="spawn")

What holds: an ``image_id`` is one sample, the same bytes whatever the number of workers and whatever else the process
does, and it is image number ``image_id`` of ``generate`` with the same run and seed. Each of the loader's workers
yields its share, and the shares together are every sample once. The order, too, is that without workers where the
dataset knows the loader's ``batch_size``: workers take turns by batches, and each draws all structures but renders its
own batches alone. Where it does not, workers take turns by chunks of 64 images, which a loader puts in the same order
only where its batches are of 64.

Axis letters: N scenes, M nodes, n objects of an image, H W.
"""

import atexit
import os
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from probscene.batch import RenderBatch, Renderer
from probscene.errors import ModelError, ProbsceneError
from probscene.keypoints import keypoints
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.request import Renderable

from ..arguments import BoxMargin, checked_box_margin
from ..chunks import CHUNK, as_written, draw_chunk
from ..fitting.run import RunFolder, is_run
from ..loading import lasting_reference, load_model, renderer_for, split_reference
from . import amodal
from .coco import check_margin_classes, check_min_visible, labelled, with_margin
from .depth import depth_of

Sample = tuple[Tensor, dict[str, Any]]
_ENDLESS = 1 << 20  # chunks of an epoch that has no end


class SceneDataset(IterableDataset):
    """Labelled images ``(image, target)`` in the form that torchvision's detectors are trained on.

    ``image`` is ``(3, H, W)`` float32 from 0 to 1, RGB. ``target`` holds ``boxes`` ``(n, 4)`` float32 x0, y0, x1, y1 in
    pixels, ends exclusive; ``labels`` ``(n,)`` int64 from 1, 0 being the background; ``masks`` ``(n, H, W)`` uint8 of
    what is visible; ``area`` ``(n,)`` float32, its pixels; ``iscrowd`` ``(n,)`` int64 zeros; ``amodal_boxes``
    ``(n, 4)`` float32, boxes of the whole silhouettes, which others may cover and the canvas may cut; ``visible``
    ``(n,)`` float32, the visible fraction, see ``RenderBatch``; ``image_id``, an int. An image may have no object:
    n = 0. Where renders have it, ``depth`` ``(H, W)`` float32 is metres along the camera's z, infinity where there is
    sky. What a generator does not tell, of depth and of whole silhouettes, is not in the target. Where the program's
    sprites name keypoints, ``keypoints`` ``(n, K, 3)`` float32 are x, y and visibility, in the order of the class's
    names, see ``probscene.keypoints``; zeros where a class has fewer than K.

    Worker processes start the engine themselves: give the loader ``multiprocessing_context="spawn"``. Several ranks of
    a distributed training take seeds of their own.

    Args:
        source: a run or its folder, for the learnt structures; or a model, its built-in name or its file, for the
            prior's.
        num: images of an epoch; None for no end.
        seed: of everything random.
        min_visible: objects of which a smaller fraction is visible are left out of the target.
        box_margin: pixels by which ``boxes`` are wider on each side, see ``DatasetOptions``.
        batch_size: the loader's, where the order must not depend on the number of workers.
        policy: other structures, over the grammar of ``source``.
        amodal: targets also have ``amodal_masks`` ``(n, H, W)`` uint8, of the whole silhouettes within the image; each
            object that is not wholly visible is drawn once more, alone.

    Attributes:
        model: the scene model.
        classes: the names of the labels 1, 2, ...

    Raises:
        ProbsceneError: a number out of its range; while iterating, amodal masks of a generator's objects.
        RunError, ModelError: see ``RunFolder`` and ``load_model``; while iterating, see ``sample``.
    """

    def __init__(
        self,
        source: RunFolder | SceneModel | Path | str,
        num: int | None = None,
        seed: int = 0,
        min_visible: float = 0.0,
        batch_size: int | None = None,
        policy: Policy | None = None,
        box_margin: BoxMargin = 0,
        amodal: bool = False,
    ):
        for name, number in (("images", num), ("images of a batch", batch_size)):
            if number is not None and number < 1:
                raise ProbsceneError(f"expected a positive number of {name}, got {number}.")
        if seed < 0:
            raise ProbsceneError(f"expected a seed of 0 or more, got {seed}.")
        check_min_visible(min_visible)
        self.num, self.seed, self.batch_size = num, seed, batch_size
        self.min_visible, self.amodal = min_visible, amodal
        self.box_margin = checked_box_margin(box_margin)
        self._source = source if isinstance(source, SceneModel) else _resolved(source)
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # workers that persist see it change
        self._given, self._opened = policy, None
        self.classes = self.model.classes
        check_margin_classes(self.model, self.box_margin)

    @property
    def model(self) -> SceneModel:
        """What draws the scenes."""
        return self._open()[0]

    def set_epoch(self, epoch: int) -> None:
        """Go on with fresh scenes from the next iteration on: those that ``generate`` would make after the scenes of
        the epochs before, which are of whole chunks.

        Raises:
            ProbsceneError: a negative number.
        """
        if epoch < 0:
            raise ProbsceneError(f"expected an epoch of 0 or more, got {epoch}.")
        self._epoch.fill_(epoch)

    def __iter__(self) -> Iterator[Sample]:
        """This process's share of the samples.

        Raises:
            ProbsceneError: in a worker forked from a process that had rendered.
        """
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        model, policy = self._open()
        if info is not None:
            # Threads of libraries that are at work when a process ends abort it now and then; a worker has nothing to
            # put in order. Registered last, this is called first.
            atexit.register(os._exit, 0)
        render = renderer_for(model, threads=1)
        start = int(self._epoch) * (_ENDLESS if self.num is None else -(-self.num // CHUNK))
        share = CHUNK if self.batch_size is None or workers == 1 else self.batch_size
        drawn, scenes = None, None
        for turn in count(worker, workers):
            at, stop = turn * share, (turn + 1) * share
            stop = stop if self.num is None else min(stop, self.num)
            if at >= stop:
                return
            while at < stop:
                chunk, first = divmod(at, CHUNK)
                last = min(first + stop - at, CHUNK)
                if scenes is None or drawn != chunk:
                    drawn, scenes = chunk, draw_chunk(model, policy, self.seed, start + chunk)
                drawing = scenes.drawing[first:last]
                if self.amodal:
                    amodal.drawable(model, drawing)  # before it is rendered
                batch = with_margin(model, render(drawing), self.box_margin)
                yield from self._samples(model, render, drawing, batch, (start + chunk) * CHUNK + first)
                at += last - first

    def __len__(self) -> int:
        """Images of an epoch.

        Raises:
            TypeError: there is no end, as of a generator.
        """
        if self.num is None:
            raise TypeError("expected a dataset with an end, got one without; give SceneDataset a num.")
        return self.num

    def __bool__(self) -> bool:
        return True

    @staticmethod
    def collate(samples: list[Sample]) -> tuple[list[Tensor], list[dict[str, Any]]]:
        """A loader's ``collate_fn``: a list of images and one of targets, as torchvision's detectors take them."""
        images, targets = zip(*samples, strict=True)
        return list(images), list(targets)

    def _samples(
        self, model: SceneModel, render: Renderer, drawing: Renderable, batch: RenderBatch, first: int
    ) -> Iterator[Sample]:
        images, points = as_written(model, batch.image), keypoints(drawing, model.canvas)
        category, depth = labelled(model, batch, self.min_visible), depth_of(batch)
        whole_masks = None
        if self.amodal:
            whole_masks = amodal.masks(render, amodal.drawable(model, drawing), batch, category)
        for i, image in enumerate(images):
            nodes = category[i].nonzero()[:, 0]
            instance = batch.instance[i]
            target = {
                "boxes": batch.box[i, nodes],
                "labels": category[i, nodes],
                "masks": (instance == (nodes + 1).view(-1, 1, 1).to(instance.dtype)).to(torch.uint8),
                "area": batch.pixels[i, nodes].float(),
                "iscrowd": torch.zeros(len(nodes), dtype=torch.int64),
                "image_id": first + i,
            }
            whole = {"amodal_boxes": batch.amodal_box[i, nodes].float(), "visible": batch.visible[i, nodes]}
            unknown = {"amodal_boxes": "amodal_box"}
            target |= {key: value for key, value in whole.items() if unknown.get(key, key) not in batch.unknown}
            if points is not None:
                target["keypoints"] = points.points[i, nodes].float()
            if whole_masks is not None:
                masks = [mask for _, _, mask in islice(whole_masks, len(nodes))]
                target["amodal_masks"] = torch.stack(masks).to(torch.uint8) if masks else target["masks"]
            if depth is not None:
                target["depth"] = depth[i]
            yield image.expand(3, -1, -1).to(torch.float32, memory_format=torch.contiguous_format).div(255), target

    def _open(self) -> tuple[SceneModel, Policy]:
        """The model and the structures, loaded once a process."""
        if self._opened is None:
            if isinstance(self._source, SceneModel):
                model, policy = self._source, self._source.prior
            elif is_run(self._source):
                run = RunFolder.at(Path(self._source))
                model, policy = run.model, run.guide
            else:
                model = load_model(self._source)
                policy = model.prior
            self._opened = model, policy if self._given is None else self._given
        return self._opened

    def __getstate__(self) -> dict[str, Any]:
        """Without what each process opens for itself.

        Raises:
            ModelError: a model that only this process has loaded.
        """
        module = getattr(getattr(self._source, "program", None), "__module__", "")
        if module.startswith("probscene_model_"):  # of load_model
            raise ModelError(
                "expected a model that worker processes can load, got one that load_model gave; name its file to "
                "SceneDataset instead."
            )
        return {**self.__dict__, "_opened": None}


def _resolved(source: RunFolder | Path | str) -> str:
    """A folder or a file that another process finds, whatever its working folder."""
    path = str(source.path if isinstance(source, RunFolder) else source)
    return lasting_reference(path) if Path(split_reference(path)[0]).exists() else path
