"""``probscene train`` and ``predict``: a detector that is kept, and what it finds in photographs."""

from pathlib import Path
from typing import Annotated

import typer

from ..arguments import range_given, size_given, words_given
from .application import app
from .options import BoxMargin, Seed, ValueRange


@app.command()
def train(
    model_or_run: Annotated[
        str, typer.Argument(metavar="MODEL_OR_RUN", help="A finished run, or a model, whose prior is drawn.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write.")],
    real: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Photographs, some of them labelled; or a labelled set alone.")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Their labels: COCO, KITTI or YOLO; PATH@LIST for some.")
    ] = None,
    test: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Labelled photographs to test it on; PATH@LIST for some.")
    ] = None,
    hold_out: Annotated[
        int | None, typer.Option(metavar="N", help="Test it on N of the labelled photographs, instead of --test.")
    ] = None,
    generate: Annotated[int, typer.Option(metavar="N", help="How many images of the run it is shown first.")] = 600,
    min_visible: Annotated[
        float, typer.Option(metavar="FRACTION", help="No label there for objects of which less is visible.")
    ] = 0.2,
    box_margin: BoxMargin = 0,
    classes: Annotated[
        str | None, typer.Option(metavar="NAME,...", help="What it learns; the model's classes if not given.")
    ] = None,
    detector: Annotated[str, typer.Option(metavar="NET", help="efficientnet or maskrcnn=FILE.")] = "efficientnet",
    iterations: Annotated[
        int | None, typer.Option(metavar="N", help="Steps of the training; 600, of maskrcnn 5000.")
    ] = None,
    batch: Annotated[int | None, typer.Option(metavar="N", help="Images a step; 4, of maskrcnn 2.")] = None,
    rate: Annotated[float | None, typer.Option(metavar="X", help="Of Adam; the detector's if not given.")] = None,
    finetune_fraction: Annotated[
        float, typer.Option(metavar="FRACTION", help="Of the images it is shown, that are photographs.")
    ] = 0.5,
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Images come so large; about 256x192 if not given.")
    ] = None,
    seed: Seed = 0,
    workers: Annotated[
        int, typer.Option(metavar="W", help="Processes that generate; the bytes do not depend on it.")
    ] = 1,
    value_range: ValueRange = None,
    onnx: Annotated[bool, typer.Option("--onnx", help="Also write detector.onnx.")] = False,
) -> None:
    """Train a detector on generated images, then on labelled photographs, and keep it."""
    from rich.console import Console

    from ..api import calls
    from ..detectors.tables import show_scores
    from ..detectors.train import TrainOptions
    from ..trial.trial import TrainingBudget

    options = TrainOptions(
        generate=generate,
        test=test,
        hold_out=hold_out,
        classes=None if classes is None else words_given(classes),
        detector=detector,
        budget=TrainingBudget(iterations, batch, rate, finetune_fraction),
        size=size_given(size),
        min_visible=min_visible,
        box_margin=box_margin,
        seed=seed,
        value_range=range_given(value_range),
        onnx=onnx,
    )
    trained = calls.train(model_or_run, real, labels, out, options, workers=workers)
    show_scores(trained, Console(highlight=False))
    print(f"The detector is in {out}; probscene predict {out} PHOTOS --out predicted.json labels photographs with it.")


@app.command()
def predict(
    detector: Annotated[Path, typer.Argument(metavar="DETECTOR", help="A folder, made by 'probscene train'.")],
    photos: Annotated[list[Path], typer.Argument(metavar="PHOTOS...", help="A folder of photographs, or photographs.")],
    out: Annotated[Path, typer.Option(metavar="PATH", help="The file to write; of YOLO a new folder.")],
    format: Annotated[str, typer.Option(metavar="FORMAT", help="coco or yolo.")] = "coco",
    min_score: Annotated[
        float | None, typer.Option(metavar="X", help="Of what is written; if not given, where it made fewest errors.")
    ] = None,
    overlays: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Also draw what is found on each photograph.")
    ] = None,
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave out files that do not decode.")] = False,
) -> None:
    """Write what a trained detector finds in photographs, as labels with scores."""
    from rich.console import Console

    from ..api import calls
    from ..detectors.tables import show_predictions

    found = calls.predict(detector, photos, out, format, min_score=min_score, overlays=overlays, skip_bad=skip_bad)
    show_predictions(found, Console(highlight=False))
    print(f"The labels are in {out}" + (f", the pictures in {overlays}" if overlays is not None else ""))
