"""``probscene check``, ``preview``, ``view``, ``label``: what is done with a model, or with what a run has learnt."""

from pathlib import Path
from typing import Annotated

import typer

from probscene.errors import ModelError

from ..arguments import checked_seed
from .application import app
from .options import Assets, Model, Seed, ValueRange


@app.command()
def begin(
    photos: Annotated[Path, typer.Argument(metavar="PHOTOS", help="A folder of photographs.")],
    labels: Annotated[
        Path, typer.Option(metavar="PATH", help="Boxes or masks of some of them: COCO, KITTI or YOLO.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write: a model and its pictures.")],
    name: Annotated[str | None, typer.Option(metavar="NAME", help="Of the model; the folder's if not given.")] = None,
    canvas: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Of its scenes; most photographs' if not given.")
    ] = None,
    turn: Annotated[
        bool | None,
        typer.Option("--turn/--upright", help="Objects lie in any direction; as they do if neither is given."),
    ] = None,
    ignore: Annotated[
        str, typer.Option(metavar="NAME,...", help="Classes of what is no object, drawn without a label.")
    ] = "ignore",
    seed: Seed = 0,
    value_range: ValueRange = None,
) -> None:
    """Make a first model of a few labelled photographs: their objects, cut out, on what is left of them."""
    from ..arguments import range_given, size_given, words_given
    from ..cut_paste.begin import BeginOptions
    from ..cut_paste.begin import begin as made

    options = BeginOptions(
        name=name,
        canvas=size_given(canvas),
        turn=turn,
        ignore=tuple(words_given(ignore)),
        value_range=range_given(value_range),
        seed=seed,
    )
    found = made(photos, labels, out, options)
    for note in found.notes:
        print(f"Note: {note}")
    counted = ", ".join(f"{found.cutouts[name]} of {number} {name}" for name, number in found.objects.items())
    print(f"Cut out: {counted}; {found.grounds} grounds. Look at {out / 'cutouts.png'}, and delete what is cut badly.")
    print(f"The model is {found.path}; try: probscene preview {found.path} --out preview.png")


@app.command()
def check(
    model: Model,
    assets: Assets = None,
    render: Annotated[bool, typer.Option("--render", help="Also see whether its generator can be relied on.")] = False,
) -> None:
    """Say whether a model's grammar is sound and its program runs, what can be seen of it, and what to fix."""
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


@app.command()
def preview(
    model_or_run: Annotated[str, typer.Argument(metavar="MODEL_OR_RUN", help="A model, or a finished run.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The picture to write, a PNG.")],
    num: Annotated[int, typer.Option(help="How many scenes.")] = 16,
    seed: Seed = 0,
    boxes: Annotated[bool, typer.Option("--boxes", help="Draw boxes and class names.")] = False,
    assets: Assets = None,
) -> None:
    """Draw a grid of scenes: of a model's prior, or of what a run has learnt."""
    from ..views.preview import preview

    preview(model_or_run, out, num, checked_seed(seed), boxes, assets)
    print(f"{num} scenes in {out}")


@app.command()
def view(
    model_or_run: Annotated[str, typer.Argument(metavar="MODEL_OR_RUN", help="A model, or a finished run.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="scene.rrd for Rerun's viewer, or scene.glb (glTF, 3D).")],
    num: Annotated[int, typer.Option(help="How many scenes, one after the other; a .glb holds one.")] = 1,
    seed: Seed = 0,
    assets: Assets = None,
) -> None:
    """Write scenes that one can turn: of a model's prior, or of what a run has learnt."""
    from ..views.export import view

    view(model_or_run, out, num, checked_seed(seed), assets)
    print(f"{num} {'scene' if num == 1 else 'scenes'} in {out}")


@app.command()
def label(
    model_or_run: Annotated[
        str, typer.Argument(metavar="MODEL_OR_RUN", help="A model, or a run: one that counts proposes better.")
    ],
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="A folder of PNG, JPEG or TIFF images.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write: a sheet, a CSV, the pictures.")],
    number: Annotated[int, typer.Option(metavar="N", help="How many images to label.")] = 10,
    labels: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Of images that are labelled already; others are proposed.")
    ] = None,
    seed: Seed = 0,
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave out files that do not decode.")] = False,
    assets: Assets = None,
    value_range: ValueRange = None,
) -> None:
    """Propose which images to label next, and write the sheet in which to count."""
    from ..api import label
    from ..arguments import range_given
    from ..fitting.begin import ModelFile
    from ..targets import TargetImages

    images = TargetImages(target, skip_bad, range_given(value_range))
    sheet = label.label(ModelFile(model_or_run, assets), images, out, number, labels, seed=seed)
    print(f"Count in {len(sheet.names)} pictures: open {sheet.page} in a browser, or fill in {sheet.table}")
