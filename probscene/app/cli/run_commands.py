"""``probscene generate``, ``evaluate``, ``report`` and ``compare``: what is done with a run."""

from pathlib import Path
from typing import Annotated

import typer

from .application import command, command_line
from .options import (
    BoxMargin,
    ClusterAddress,
    JudgedScenes,
    MinHeight,
    MinVisible,
    RunPath,
    Seed,
    SomeLabels,
    ValueRange,
    Visible,
)


@command()
def generate(
    run: RunPath,
    *,
    num: Annotated[int, typer.Option(metavar="N", help="Number of images.")],
    out: Annotated[str, typer.Option(metavar="DIR", help="Folder to write, or an address such as s3://bucket/folder.")],
    format: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FORMAT",
            help="coco (if not given), panoptic, yolo, yolo-seg, yolo-obb, yolo-pose, kitti, webdataset, depth, or "
            "images for no labels; repeat for more.",
        ),
    ] = None,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(metavar="N", help="Processes; the bytes do not depend on it.")] = 1,
    min_visible: MinVisible = 0.0,
    box_margin: BoxMargin = "0",
    amodal: Annotated[
        bool,
        typer.Option("--amodal", help="Add masks of whole objects (COCO, WebDataset).", rich_help_panel="Labels"),
    ] = False,
    values: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SITE,...",
            help="Add values of these sites to annotations (COCO, WebDataset).",
            rich_help_panel="Labels",
        ),
    ] = None,
    flat: Annotated[
        bool,
        typer.Option("--flat", help="Write all images into one folder, however many.", rich_help_panel="Computing"),
    ] = False,
    shard: Annotated[
        str | None,
        typer.Option(
            metavar="I/N",
            help="Make part I of N, I from 0; together they are the dataset.",
            rich_help_panel="Computing",
        ),
    ] = None,
    cluster: ClusterAddress = None,
) -> str:
    """Write a labelled dataset of a fit. After an interruption, repeat the command to continue."""
    from ..datasets.generate import DatasetOptions, generate, workers_or_cluster
    from ..fitting.run import RunFolder
    from ..progress import Display
    from ..workers.cluster import connected

    with Display() as show, connected(cluster, show.say) as nodes:
        said = show.stage("generating")
        opened = RunFolder.at(run)
        options = DatasetOptions(
            min_visible=min_visible, flat=flat, box_margin=box_margin, amodal=amodal, values=values or (), shard=shard
        )
        processes = workers_or_cluster(workers, nodes)
        dataset = generate(opened, num, out, seed, processes, format or "coco", said, options)
    print(f"{dataset.num} images in {dataset.path}, {dataset.made} of them made now")
    if not dataset.finished:
        return "the same command without --shard, when all shards are done; it writes the label files."
    return command_line("train", run, "--real", "PHOTOS", "--labels", "LABELS", "--out", "DETECTOR")


@command()
def evaluate(
    run: RunPath,
    *,
    target: Annotated[Path, typer.Option(metavar="DIR", help="Folder of images to compare with.")],
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Their labels: counts.csv, provenance.jsonl, COCO .json, KITTI label_2 or YOLO labels.",
        ),
    ] = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write all figures to this file.")] = None,
    num: Annotated[int, typer.Option(metavar="N", help="Structures to sample.")] = 10000,
    scenes: JudgedScenes = None,
    some_labels: SomeLabels = False,
    min_height: MinHeight = 0.0,
    visible: Visible = None,
    features: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NET",
            help="KID and FID by run, efficientnet, inception[=FILE] or resnet50[=FILE]; repeat for more.",
            rich_help_panel="Images",
        ),
    ] = None,
    num_images: Annotated[
        str,
        typer.Option(
            "--images", metavar="N", help="Images a side for KID and FID at most, or all.", rich_help_panel="Images"
        ),
    ] = "1000",
    value_range: ValueRange = None,
) -> str:
    """Judge a fit, and compare its counts with labels or with the network's."""
    from rich.console import Console

    from ..arguments import number_or_all, range_given
    from ..evaluation import diagnose as verdict
    from ..evaluation.evaluate import ImageComparison, evaluate
    from ..evaluation.labels import read_labels
    from ..files import make_folder, write_json
    from ..fitting.run import RunFolder
    from ..progress import Display
    from ..targets import open_images
    from ..views import tables, verdict_text

    opened = RunFolder.at(run)
    opened.check_finished()
    most = number_or_all(num_images, "images to compare")
    if json is not None:
        make_folder(json.parent)
    chosen = range_given(value_range) or opened.record.get("value_range")
    with Display() as show:
        images = open_images(target, opened.model, opened.record["skip_bad"], show, chosen)
        truth = None if labels is None else read_labels(labels, opened.model, images, some_labels, min_height)
        compared = ImageComparison(features or (), most)
        found = evaluate(opened, images, truth, show, num, compared=compared, visible=visible)
        judged = verdict.diagnose(opened, images, show, scenes, found) if scenes != 0 else None
    console = Console(highlight=False)
    if judged is not None:
        verdict_text.show(judged, console)
    tables.show(found, console)
    if json is not None:
        write_json(json, found.record() | ({} if judged is None else {"trust": judged.record()}))
    return command_line("report", run, *(() if labels is None else ("--labels", labels)))


@command()
def report(
    run: RunPath,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="HTML file to write; report.html in RUN if not given.")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Labels of the run's target, as in evaluate.")
    ] = None,
    num: Annotated[int, typer.Option(metavar="N", help="Structures to sample.")] = 10000,
    scenes: JudgedScenes = None,
    some_labels: SomeLabels = False,
    visible: Visible = None,
) -> str:
    """Write one self-contained HTML page about a run."""
    from ..api import calls
    from ..evaluation.labels import TargetLabels

    truth = None if labels is None else TargetLabels(labels, some_labels)
    path = calls.report(run, out, truth, num=num, scenes=scenes, visible=visible)
    print(f"The report is {path}")
    return command_line("generate", run, "--num", 10_000, "--out", "DATASET")


@command()
def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Finished runs of one model.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="PNG to write.")],
    target: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of images to compare with; the runs' own if not given.")
    ] = None,
    labels: Annotated[Path | None, typer.Option(metavar="PATH", help="Their labels, as in evaluate.")] = None,
    some_labels: SomeLabels = False,
    min_height: MinHeight = 0.0,
    visible: Visible = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write all figures to this file.")] = None,
    num: Annotated[int, typer.Option(metavar="N", help="Structures to sample.")] = 10000,
) -> str:
    """Draw prior, runs and truth side by side, and print their distances."""
    from rich.console import Console

    from ..api import calls
    from ..evaluation.labels import TargetLabels
    from ..files import make_folder, write_json
    from ..views import tables

    if json is not None:
        make_folder(json.parent)
    truth = None if labels is None else TargetLabels(labels, some_labels, min_height)
    found = calls.compare(runs, target, truth, out, num=num, visible=visible)
    tables.show_comparison(found, Console(highlight=False))
    print(f"The picture is {out}")
    if json is not None:
        write_json(json, found.record())
    return command_line("generate", "RUN", "--num", 10_000, "--out", "DATASET")
