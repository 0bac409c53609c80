"""``probscene generate``, ``evaluate``, ``report`` and ``compare``: what is done with a run."""

from pathlib import Path
from typing import Annotated

import typer

from .application import app
from .options import (
    BoxMargin,
    ClusterAddress,
    JudgedScenes,
    MinHeight,
    RunPath,
    Seed,
    SomeLabels,
    ValueRange,
    Visible,
)


@app.command()
def generate(
    run: RunPath,
    num: Annotated[int, typer.Option(metavar="N", help="How many images.")],
    out: Annotated[
        str, typer.Option(metavar="DIR", help="The folder to write, or an address such as s3://bucket/folder.")
    ],
    format: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FORMAT",
            help="coco (if not given), panoptic, yolo, yolo-seg, yolo-obb, yolo-pose, kitti, webdataset, depth, or "
            "images for no labels; again for more.",
        ),
    ] = None,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(metavar="W", help="Processes; the bytes do not depend on it.")] = 1,
    min_visible: Annotated[
        float, typer.Option(metavar="FRACTION", help="No label for objects of which less is visible, 0 to 1.")
    ] = 0.0,
    shard: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="One of N commands, I from 0, that make it together; none finishes it."),
    ] = None,
    cluster: ClusterAddress = None,
    flat: Annotated[bool, typer.Option("--flat", help="One folder also for more than 10,000 images.")] = False,
    box_margin: BoxMargin = 0,
    amodal: Annotated[bool, typer.Option("--amodal", help="Also masks of whole objects, in COCO and shards.")] = False,
    values: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SITE,...", help="Sites whose values annotations have, in COCO and shards; again for more."
        ),
    ] = None,
) -> None:
    """Write a labelled dataset of the learnt structures; the same command goes on after an interruption."""
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
        print("When all shards are done, the same command without --shard writes the files of labels.")


@app.command()
def evaluate(
    run: RunPath,
    target: Annotated[Path, typer.Option(metavar="DIR", help="The images to judge by.")],
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="A counts.csv (image,CLASS,...), a provenance.jsonl, COCO's .json, KITTI's label_2, or YOLO's labels.",
        ),
    ] = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write all figures there, too.")] = None,
    num: Annotated[int, typer.Option(help="How many structures are sampled.")] = 10000,
    features: Annotated[
        list[str] | None,
        typer.Option(metavar="NET", help="KID and FID by run, efficientnet, inception[=FILE], resnet50[=FILE]; many."),
    ] = None,
    num_images: Annotated[
        str, typer.Option("--images", metavar="N", help="At most so many a side for KID and FID, or all.")
    ] = "1000",
    scenes: JudgedScenes = None,
    some_labels: SomeLabels = False,
    min_height: MinHeight = 0.0,
    visible: Visible = None,
    value_range: ValueRange = None,
) -> None:
    """Say whether a fit can be trusted, and compare its structures with the truth or with what the network sees."""
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


@app.command()
def report(
    run: RunPath,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="report.html in the run folder if not given.")
    ] = None,
    labels: Annotated[Path | None, typer.Option(metavar="PATH", help="Of the run's target, as of evaluate.")] = None,
    num: Annotated[int, typer.Option(help="How many structures are sampled.")] = 10000,
    scenes: JudgedScenes = None,
    some_labels: SomeLabels = False,
    visible: Visible = None,
) -> None:
    """Write one self-contained HTML page about a run."""
    from ..api import calls
    from ..evaluation.labels import TargetLabels

    truth = None if labels is None else TargetLabels(labels, some_labels)
    path = calls.report(run, out, truth, num=num, scenes=scenes, visible=visible)
    print(f"The report is {path}")


@app.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Finished runs of one model.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The picture to write, a PNG.")],
    target: Annotated[
        Path | None, typer.Option(metavar="DIR", help="The images to judge by; the runs' own if not given.")
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Of the target, as of evaluate, for the truth."),
    ] = None,
    some_labels: SomeLabels = False,
    min_height: MinHeight = 0.0,
    visible: Visible = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write all figures there, too.")] = None,
    num: Annotated[int, typer.Option(help="How many structures are sampled.")] = 10000,
) -> None:
    """Draw the prior, several runs and the truth side by side, and print how far each is from the truth."""
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
