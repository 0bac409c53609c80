"""Write a labelled dataset: images, labels in one format or several, and provenance.

    images/000000.png ...   grey where the model says that colour carries nothing, else RGB
    annotations.json        COCO; ``formats`` says what the others add
    provenance.jsonl        one line an image, from which it can be made again

Masks and boxes come from one render and are the same in every format that has them.

Whatever interrupts the work, the same call goes on with the chunks that are missing; the bytes depend on the settings
alone, not on the interruptions, the number of workers or what else the process does.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import probscene
from probscene.batch import RenderBatch
from probscene.errors import ModelError, ProbsceneError
from probscene.keypoints import Keypoints, keypoints
from probscene.model import SceneModel
from probscene.policy import Policy
from probscene.renderers.engine_choice import engine_version
from probscene.request import Renderable
from probscene.sampling import Scenes

from ..arguments import BoxMargin, checked_box_margin
from ..chunks import CHUNK, as_written, draw_chunk, png
from ..fitting.run import RunFolder
from ..loading import renderer_for
from ..workers.cluster import Cluster
from ..workers.processes import spread
from . import amodal, attributes, coco, depth, kitti, panoptic, shards, yolo
from .folder import DEFAULT_SETTINGS, LINES, WHOLE, DatasetFolder, Shard, check_begun
from .formats import parse_formats
from .places import place_at
from .provenance import image_name, provenance

ProgressCallback = Callable[[int, int], None]
"""Called with the number of images there are, and how many there are to be."""


class Dataset(NamedTuple):
    """A dataset, or a shard of it.

    Attributes:
        path: the folder, or the address.
        made: how many images this call made; 0 where they were there before.
        num: how many images there are, of the shard or of all.
        finished: whether the files of labels are written.
    """

    path: Path | str
    made: int
    num: int
    finished: bool


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """What a dataset's labels hold, and where its files go.

    Args:
        min_visible: objects of which a smaller fraction is visible have no label, in any format.
        flat: all images in one folder; of more than 10,000, a thousand share one otherwise. KITTI's folders are flat.
        box_margin: pixels by which boxes of what is visible are wider than it on each side, within the image: a number,
            or by class, as ``"plate=2,mug=4"`` or a mapping. Masks and boxes of whole silhouettes stay.
        amodal: COCO's annotations, and those of shards, have masks of whole objects, too, see ``coco``; each object
            that is not wholly visible is drawn once more, alone.
        values: names of the program's sites, such as ``"plate.x,mug.turn"``, whose values these annotations have as
            ``attributes``: those of the object, else of the nearest node above it, else of the scene.
        shard: ``"I/N"``, I from 0: makes every N-th chunk alone, and no files of labels for the whole. Several shards
            may write to one folder at once; the same call without ``shard`` makes what is missing and finishes.

    Raises:
        ProbsceneError: a fraction that is not in 0..1, a margin that is no whole number, another text for a shard.
    """

    min_visible: float = 0.0
    flat: bool = False
    box_margin: BoxMargin = 0
    amodal: bool = False
    values: str | Iterable[str] = ()
    shard: str | None = None

    def __post_init__(self):
        coco.check_min_visible(self.min_visible)
        object.__setattr__(self, "box_margin", checked_box_margin(self.box_margin))
        object.__setattr__(self, "values", attributes.chosen(self.values))
        self.part()

    def part(self) -> Shard:
        """The shard to make, or the whole."""
        return WHOLE if self.shard is None else Shard.from_text(self.shard)

    @property
    def margin(self) -> int | dict[str, int]:
        """What ``box_margin`` says."""
        return checked_box_margin(self.box_margin)

    @property
    def sites(self) -> tuple[str, ...]:
        """The names in ``values``."""
        return tuple(self.values)

    def record(self) -> dict[str, Any]:
        """What the dataset's settings name: those that are not the default."""
        names = ",".join(self.sites)
        own = {"min_visible": float(self.min_visible), "box_margin": self.margin, "amodal": bool(self.amodal)}
        return {key: value for key, value in {**own, "values": names}.items() if value != DEFAULT_SETTINGS[key]}


def generate(
    run: RunFolder,
    num: int,
    out: Path | str,
    seed: int = 0,
    workers: int | Cluster = 1,
    format: str | Iterable[str] = "coco",
    progress: ProgressCallback | None = None,
    options: DatasetOptions = DatasetOptions(),
) -> Dataset:
    """Write ``num`` images of the learnt structures.

    Args:
        out: the folder to write, or an address of a file system that fsspec knows, such as ``s3://bucket/folder``.
        workers: processes. More than one are spawned: a script calls this under ``if __name__ == "__main__":``. Or a
            cluster, of which all nodes make images; they have to see the folders of the run and of the dataset by the
            same paths.
        format: names of ``formats.FORMATS``, such as ``"coco"``, ``"coco,yolo"`` or ``("coco", "yolo")``; ``"images"``
            for no labels.
        progress: called with the number of images there are and ``num``; first with what an interrupted call left.

    Raises:
        ProbsceneError: a number that is not positive, a negative seed, a margin of KITTI's boxes in 3D, an unknown
            format, more classes or objects than KITTI's masks can number, no depth where it is asked for, a value that
            is no site of the program, amodal masks of a generator's objects, or either in formats that have no place
            for them.
        DataError: the folder holds other files, or a dataset of other settings.
        RunError: see ``RunFolder.guide`` and ``RunFolder.model``.
        MachineError: the disk is full, or a worker was killed; the same call goes on where it stopped. See also
            ``ActorPool.run``.
    """
    if isinstance(workers, int) and workers < 1:
        raise ProbsceneError(f"expected a positive number of workers, got {workers}.")
    job = Job(run.model, run.guide, num, out, seed, parse_formats(format), options, run.guide_hash())
    if workers == 1:
        return job.run(job.make_all, progress)
    if run.objects:
        raise ProbsceneError(
            f"expected one worker for a run with parts in memory alone ({', '.join(run.objects)}), got "
            f"{workers if isinstance(workers, int) else 'a cluster'}; fit a model and parts in files for more."
        )
    task = (run.path.resolve(), num, place_at(out).lasting, seed, job.formats, options)
    if isinstance(workers, int):
        return job.run(partial(spread, _worker, task, workers), progress)
    actors = workers.actor_pool(_actor, task)
    try:
        return job.run(actors.run, progress)
    finally:
        actors.close()


def workers_or_cluster(workers: int, cluster: Cluster | None) -> int | Cluster:
    """The one that is given.

    Raises:
        ProbsceneError: several workers and a cluster.
    """
    if cluster is not None and workers > 1:
        raise ProbsceneError(f"expected workers or a cluster, got {workers} workers and a cluster; leave one out.")
    return workers if cluster is None else cluster


def generate_scenes(
    model: SceneModel,
    policy: Policy,
    num: int,
    out: Path | str,
    seed: int = 0,
    format: str | Iterable[str] = "coco",
    progress: ProgressCallback | None = None,
    options: DatasetOptions = DatasetOptions(),
) -> Dataset:
    """``generate`` from any model and structure policy, in this process.

    The folder's settings name the model and not the policy: write those of another policy to another folder.
    """
    job = Job(model, policy, num, out, seed, parse_formats(format), options)
    return job.run(job.make_all, progress)


class Job:
    """The writing of a dataset.

    Args:
        formats: see ``formats.chosen``.
        guide_hash: SHA-256 of the policy's checkpoint, where it is a learnt one.

    Raises:
        ProbsceneError: see ``generate``.
    """

    def __init__(
        self,
        model: SceneModel,
        policy: Policy,
        num: int,
        out: Path | str,
        seed: int,
        formats: tuple[str, ...],
        options: DatasetOptions,
        guide_hash: str | None = None,
    ):
        if num < 1:
            raise ProbsceneError(f"expected a positive number of images, got {num}.")
        if seed < 0:
            raise ProbsceneError(f"expected a seed of 0 or more, got {seed}.")
        if (options.amodal or options.sites) and not {"coco", "webdataset"} & {*formats}:
            raise ProbsceneError(
                f"expected coco or webdataset among the formats for {'amodal masks' if options.amodal else 'values'}, "
                f"got {', '.join(formats)}; add one of them."
            )
        coco.check_margin_classes(model, options.margin)
        if "kitti" in formats:
            kitti.check(model)
        self.model, self.policy, self.formats, self.options = model, policy, formats, options
        self.origin = {"seed": seed, "model": model.name, "guide": guide_hash, "version": probscene.__version__}
        self.origin |= options.record()
        self.folder = DatasetFolder(out, self.origin, num, formats, options.flat)
        self._renderer = renderer_for(model, threads=1)
        # Another program's images have no engine of ours.
        self._engine = {"engine": engine_version()} if model.generator is None else {}

    def run(
        self, work: Callable[[list[int], Callable[[int], None]], None], progress: ProgressCallback | None
    ) -> Dataset:
        """Do what is missing of the shard by ``work(chunks, done)``; of the whole, then write the labels."""
        folder, shard, made = self.folder, self.options.part(), 0
        if not folder.finished:
            self._check()
        chunks, num = folder.missing(shard), sum(map(folder.size, folder.chunks_of(shard)))
        before = num - sum(map(folder.size, chunks))

        def done(chunk: int | None) -> None:
            nonlocal made
            made += 0 if chunk is None else folder.size(chunk)
            if progress is not None:
                progress(before + made, num)

        done(None)
        work(chunks, done)
        if shard == WHOLE:
            folder.finish(self._labels())
        return Dataset(folder.place.where, made, num, folder.finished)

    def _check(self) -> None:
        """See that the model's scenes have what is asked for, before anything is written."""
        boxes = "kitti" in self.formats and bool(self.options.margin)
        posed = "yolo-pose" in self.formats
        if not ("depth" in self.formats or boxes or posed or self.options.amodal or self.options.sites):
            return
        scenes = draw_chunk(self.model, self.policy, self.origin["seed"], 0)
        attributes.check(self.model, scenes, self.options.sites)
        if self.options.amodal:
            amodal.drawable(self.model, scenes.drawing)
        if posed and not self._named(keypoints(scenes.drawing[:1], self.model.canvas)):
            raise ProbsceneError(
                f"expected sprites of model {self.model.name!r} with keypoints, for format yolo-pose, got none; "
                "name some: Sprites(..., keypoints={'nose': (0.5, 0.2)}), or choose other formats."
            )
        if "depth" in self.formats or boxes:
            first = self._renderer(scenes.drawing[:1])
            if boxes:
                kitti.check_box_margin(self.model, first, self.options.margin)
            if "depth" in self.formats:
                depth.files(self.model, first)

    def make_all(self, chunks: list[int], done: Callable[[int], None]) -> None:
        """Make chunks one after the other."""
        for chunk in chunks:
            done(self.make(chunk))

    def make(self, chunk: int) -> int:
        """Draw, render and write a chunk; returns its number.

        Raises:
            MachineError: the disk is full.
        """
        first, size = chunk * CHUNK, self.folder.size(chunk)
        scenes = draw_chunk(self.model, self.policy, self.origin["seed"], chunk)
        drawing = scenes.drawing[:size]
        batch = coco.with_margin(self.model, self._renderer(drawing), self.options.margin)
        record: dict[str, Any] = {"annotations": [], "keypoints": {}}
        if self.formats != ("images",):
            record |= self._annotated(scenes, drawing, batch, first)
        origin = self.origin | self._engine
        record["provenance"] = provenance(self.model, scenes, first, origin, self.folder.flat)[:size]
        files, links = self._files(drawing, batch, first, record)
        if "panoptic" in self.formats:
            found = panoptic.segments(self.model, batch, record["annotations"], first, self.options.min_visible)
            record["panoptic"] = found[0]
            files |= {panoptic.file_name(first + i, self.folder.flat): file for i, file in enumerate(found[1])}
        self.folder.write(chunk, files, links, record)
        return chunk

    def _annotated(self, scenes: Scenes, drawing: Renderable, batch: RenderBatch, first: int) -> dict[str, Any]:
        """Annotations of rendered scenes, and names of keypoints by class."""
        more, points = [], keypoints(drawing, self.model.canvas)
        if points is not None:
            more.append(coco.with_keypoints(self.model, points))
        if self.options.amodal:
            category = coco.labelled(self.model, batch, self.options.min_visible)
            whole = amodal.masks(self._renderer, amodal.drawable(self.model, drawing), batch, category)
            more.append(coco.with_amodal(whole))
        if self.options.sites:
            values = attributes.Attributes(scenes, self.options.sites)
            more.append(lambda scene, node: {"attributes": values(scene, node)})
        found = coco.annotations(self.model, batch, first, self.options.min_visible, more)
        return {"annotations": found, "keypoints": self._named(points)}

    def _named(self, points: Keypoints | None) -> dict[str, tuple[str, ...]]:
        """The names of keypoints by class."""
        return {} if points is None else {c: points.names[c] for c in self.model.classes if c in points.names}

    def _files(
        self, drawing: Renderable, batch: RenderBatch, first: int, record: dict[str, Any]
    ) -> tuple[dict[str, bytes], dict[str, str]]:
        """What is written of each image at once, and further names of that; see ``DatasetFolder.write``."""
        of_image: dict[int, list] = {first + i: [] for i in range(len(batch.image))}
        for annotation in record["annotations"]:
            of_image[annotation["image_id"]].append(annotation)
        images = map(png, as_written(self.model, batch.image))
        files = {self.folder.image(i): image for i, image in zip(of_image, images, strict=True)}
        links, flat = {}, self.folder.flat
        if "yolo" in self.formats:
            files |= {yolo.label_name(i, flat): yolo.label(self.model, of_image[i]).encode() for i in of_image}
        lines = {}
        if "yolo-seg" in self.formats:
            lines["yolo-seg"] = yolo.polygons(self.model, batch, self.options.min_visible)
        if "yolo-obb" in self.formats:
            lines["yolo-obb"] = yolo.oriented(self.model, batch, drawing, self.options.min_visible, self.options.margin)
        if "yolo-pose" in self.formats:
            number = _most(record["keypoints"])
            lines["yolo-pose"] = [yolo.label(self.model, of_image[i], number) for i in of_image]
        for folder, texts in lines.items():
            names = [f"{folder}/{yolo.label_name(i, flat)}" for i in of_image]
            files |= {name: text.encode() for name, text in zip(names, texts, strict=True)}
            links |= {f"{folder}/{image_name(i, flat)}": self.folder.image(i) for i in of_image}
        if "depth" in self.formats:
            depths = depth.files(self.model, batch)
            files |= {depth.file_name(i, flat): each for i, each in zip(of_image, depths, strict=True)}
        if "kitti" in self.formats:
            masks = kitti.instances(self.model, batch, first, self.options.min_visible)
            files |= {kitti.file_name("label_2", i): kitti.label(self.model, of_image[i]).encode() for i in of_image}
            files |= {kitti.file_name("instance", i): mask for i, mask in zip(of_image, masks, strict=True)}
            if batch.space is not None:
                calibs = map(kitti.calib, batch.space.intrinsics)
                files |= {kitti.file_name("calib", i): text.encode() for i, text in zip(of_image, calibs, strict=True)}
            links |= {kitti.file_name("image_2", i): self.folder.image(i) for i in of_image}
        return files, links

    def _labels(self) -> dict[str, Callable[[Path], Any]]:
        """What is written when every chunk is there."""
        model, folder, flat = self.model, self.folder, self.folder.flat
        info = {key: value for key, value in folder.settings.items() if key != "flat"}
        labels = {}
        if "coco" in self.formats:
            labels["annotations.json"] = lambda path: self._write_coco(path, info)
        if "panoptic" in self.formats:
            segments = (record["panoptic"] for record in folder.records())
            labels["panoptic.json"] = lambda path: panoptic.write(path, model, folder.num, info, segments, flat)
        for name in ("yolo", "yolo-seg", "yolo-obb", "yolo-pose"):
            if name in self.formats:
                labels["data.yaml" if name == "yolo" else f"{name}/data.yaml"] = partial(self._write_data, name)
        if "webdataset" in self.formats:
            for number, chunks in enumerate(folder.chunks(shards.CHUNKS)):
                labels[shards.shard_name(number)] = partial(self._write_shard, chunks)
        lines = (line for record in folder.records() for line in record["provenance"])
        labels[LINES] = lambda path: _write_lines(path, (json.dumps(line, ensure_ascii=False) + "\n" for line in lines))
        return labels

    def _write_coco(self, path: Path, info: dict[str, Any]) -> None:
        """Write COCO's annotations."""
        names = next(self.folder.records())["keypoints"]
        found = (annotation for record in self._records() for annotation in record["annotations"])
        coco.write(path, self.model, self.folder.num, info, found, self.folder.flat, names)

    def _write_data(self, name: str, path: Path) -> None:
        """Write the ``data.yaml`` of a format of YOLO."""
        number = 0
        for record in self._records() if name == "yolo-pose" else ():
            number = _most(record["keypoints"])
        path.write_text(yolo.data(self.model, number), encoding="utf-8", newline="\n")

    def _records(self) -> Iterator[dict[str, Any]]:
        """The chunks' records.

        Raises:
            ModelError: keypoints of some scenes have other names than those of others.
        """
        names = None
        for record in self.folder.records():
            names = record["keypoints"] if names is None else names
            if record["keypoints"] != names:
                raise ModelError(
                    f"expected model {self.model.name!r} to name the same keypoints whatever it draws, got {names} "
                    f"in some scenes and {record['keypoints']} in others; give scene.draw every layer always."
                )
            yield record

    def _write_shard(self, chunks: range, path: Path) -> None:
        def samples() -> Iterator[tuple[int, dict[str, bytes]]]:
            for record in self.folder.records(chunks):
                found = list(shards.labels(self.model, record))
                images = self.folder.place.read_all([self.folder.image(i) for i, _ in found])
                for (i, label), image in zip(found, images, strict=True):
                    yield i, {"png": image, "json": label}

        shards.write(path, samples())


def _most(keypoints: dict[str, Any]) -> int:
    """The largest number of keypoints that a class has."""
    return max(map(len, keypoints.values()), default=0)


def _worker(
    run: Path, num: int, out: str, seed: int, formats: tuple[str, ...], options: DatasetOptions
) -> Callable[[int], int]:
    """What a worker process does with a chunk's number."""
    opened = RunFolder.at(run)
    return Job(opened.model, opened.guide, num, out, seed, formats, options, opened.guide_hash()).make


def _actor(run: Path, num: int, out: str, *arguments: Any) -> Callable[[int], int]:
    """The same on a node of a cluster."""
    make = _worker(run, num, out, *arguments)
    check_begun(out)
    return make


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.writelines(lines)
