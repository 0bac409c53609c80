"""``probscene begin``, ``check``, ``preview``, ``view`` and ``label``: what is done with a model or a run."""

from pathlib import Path
from typing import Annotated

import typer

from probscene.errors import ModelError

from ..arguments import checked_seed
from .application import command, command_line
from .options import Assets, Model, Seed, ValueRange


@command()
def begin(
    photos: Annotated[Path, typer.Argument(metavar="PHOTOS", help="Folder of photographs.")],
    labels: Annotated[Path, typer.Option(metavar="PATH", help="Boxes or masks in some of them: COCO, KITTI or YOLO.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write: a model and its pictures.")],
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the model; the folder's name if not given.")
    ] = None,
    canvas: Annotated[
        str | None,
        typer.Option(metavar="WIDTHxHEIGHT", help="Size of scenes; the most frequent of the photographs if not given."),
    ] = None,
    turn: Annotated[
        bool | None,
        typer.Option("--turn/--upright", help="Rotate objects, or do not; class by class if neither is given."),
    ] = None,
    ignore: Annotated[
        str, typer.Option(metavar="NAME,...", help="Classes to draw without a label, such as dirt.")
    ] = "ignore",
    detections: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="What a detector found, for more backgrounds and for what misleads it."),
    ] = None,
    seed: Seed = 0,
    value_range: ValueRange = None,
) -> str:
    """Make a first model from a few labelled photographs, by cutting out their objects."""
    from ..arguments import range_given, size_given, words_given
    from ..cut_paste.begin import BeginOptions
    from ..cut_paste.begin import begin as made

    options = BeginOptions(
        name=name,
        canvas=size_given(canvas),
        turn=turn,
        ignore=tuple(words_given(ignore)),
        detections=detections,
        value_range=range_given(value_range),
        seed=seed,
    )
    found = made(photos, labels, out, options)
    for note in found.notes:
        print(f"Note: {note}")
    counted = ", ".join(f"{found.cutouts[name]} of {number} {name}" for name, number in found.objects.items())
    print(f"Cut out: {counted}; {found.grounds} backgrounds. The model is {found.path}")
    print(f"Look at {out / 'cutouts.png'}, and delete the files of bad cut-outs from {out / 'cutouts'}.")
    return command_line("preview", found.path, "--out", "preview.png")


@command()
def check(
    model: Model,
    assets: Assets = None,
    render: Annotated[bool, typer.Option("--render", help="Also test the model's own generator.")] = False,
) -> str:
    """Check a model's grammar and program, and say what to fix."""
    from ..checking.generator_check import check_generator
    from ..checking.model_check import check_model
    from ..fitting.presets import images_drawn
    from ..loading import load_model

    loaded, again = load_model(model, assets), load_model(model, assets)
    report = check_model(loaded, again=again)
    print(report)
    if render and not report.faults:
        found = check_generator(loaded, images_drawn())
        print(found)
        if found.fault:
            raise ModelError(found.fault)
    if report.faults:
        raise ModelError(f"expected a model without faults, got {model} with {len(report.faults)}; fix them first.")
    return command_line("preview", model, "--out", "preview.png", *_given(assets))


@command()
def preview(
    model_or_run: Annotated[str, typer.Argument(metavar="MODEL_OR_RUN", help="Model or finished run.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="PNG to write.")],
    num: Annotated[int, typer.Option(metavar="N", help="Number of scenes.")] = 16,
    seed: Seed = 0,
    boxes: Annotated[bool, typer.Option("--boxes", help="Draw boxes and class names.")] = False,
    assets: Assets = None,
) -> str:
    """Draw a grid of scenes of a model's prior, or of a fit."""
    from ..views.preview import preview

    preview(model_or_run, out, num, checked_seed(seed), boxes, assets)
    print(f"{num} scenes in {out}")
    return _after_looking(model_or_run, assets)


@command()
def view(
    model_or_run: Annotated[str, typer.Argument(metavar="MODEL_OR_RUN", help="Model or finished run.")],
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="scene.rrd for Rerun's viewer, or scene.glb for 3D models.")
    ],
    num: Annotated[int, typer.Option(metavar="N", help="Number of scenes; a .glb holds one.")] = 1,
    seed: Seed = 0,
    assets: Assets = None,
) -> str:
    """Write scenes of a model's prior, or of a fit, for a 3D viewer."""
    from ..views.export import view

    view(model_or_run, out, num, checked_seed(seed), assets)
    print(f"{num} {'scene' if num == 1 else 'scenes'} in {out}")
    return _after_looking(model_or_run, assets)


@command()
def label(
    model_or_run: Annotated[
        str, typer.Argument(metavar="MODEL_OR_RUN", help="Model, or a run, which proposes better.")
    ],
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="Folder of PNG, JPEG or TIFF images.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write: an HTML page, a CSV and the images.")],
    number: Annotated[int, typer.Option(metavar="N", help="Number of images to label.")] = 10,
    labels: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Labels there are already; other images are proposed.")
    ] = None,
    seed: Seed = 0,
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave out images that do not decode.")] = False,
    assets: Assets = None,
    value_range: ValueRange = None,
) -> str:
    """Propose which images to label next, and write a page to count objects in."""
    from ..api import label
    from ..arguments import range_given
    from ..fitting.begin import ModelFile
    from ..fitting.run import RunFolder, is_run
    from ..targets import TargetImages

    images = TargetImages(target, skip_bad, range_given(value_range))
    sheet = label.label(ModelFile(model_or_run, assets), images, out, number, labels, seed=seed)
    print(f"Count the objects of {len(sheet.names)} images: open {sheet.page} in a browser, or fill in {sheet.table}")
    model = RunFolder.at(Path(model_or_run)).record["model"] if is_run(model_or_run) else model_or_run
    fit = command_line("fit", model, "--target", target, "--labels", sheet.table, *_given(assets), "--out", "RUN")
    return f"{fit}, when all are counted"


def _after_looking(model_or_run: str, assets: Path | None) -> str:
    from ..fitting.run import is_run

    if is_run(model_or_run):
        return command_line("generate", model_or_run, "--num", 10_000, "--out", "DATASET")
    return command_line("fit", model_or_run, "--target", "PHOTOS", *_given(assets), "--out", "RUN")


def _given(assets: Path | None) -> tuple[object, ...]:
    return () if assets is None else ("--assets", assets)
