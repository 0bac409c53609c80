"""``probscene train`` and ``predict``: a detector that is kept, and what it finds in photographs."""

from pathlib import Path
from typing import Annotated

import typer

from ..arguments import range_given, size_given, words_given
from .application import command, command_line
from .options import (
    Batch,
    BoxMargin,
    Detector,
    Device,
    FinetuneFraction,
    Iterations,
    MinVisible,
    Rate,
    Seed,
    Size,
    ValueRange,
)


@command()
def train(
    model_or_run: Annotated[
        str, typer.Argument(metavar="MODEL_OR_RUN", help="Finished run, or a model, whose prior is drawn.")
    ],
    *,
    real: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Photographs, some of them labelled; or a labelled set.")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Their labels: COCO, KITTI or YOLO; PATH@LIST for some.")
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    test: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Labelled photographs to test on; PATH@LIST for some.")
    ] = None,
    hold_out: Annotated[
        int | None, typer.Option(metavar="N", help="Test on N of the labelled photographs, instead of --test.")
    ] = None,
    generate: Annotated[int, typer.Option(metavar="N", help="Generated images to train on first.")] = 600,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(metavar="N", help="Processes; the bytes do not depend on it.")] = 1,
    onnx: Annotated[bool, typer.Option("--onnx", help="Also write detector.onnx.")] = False,
    source: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Scenes of the run: prior, start, structure, parameters, learnt; compared if not given.",
        ),
    ] = None,
    classes: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="Classes to detect; the model's if not given.", rich_help_panel="Labels"),
    ] = None,
    min_visible: MinVisible = 0.2,
    box_margin: BoxMargin = "0",
    detector: Detector = "efficientnet",
    size: Size = None,
    iterations: Iterations = None,
    batch: Batch = None,
    rate: Rate = None,
    finetune_fraction: FinetuneFraction = 0.5,
    value_range: ValueRange = None,
    device: Device = "cpu",
) -> str:
    """Train a detector on generated images, then on labelled photographs."""
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
        budget=TrainingBudget(iterations, batch, rate, finetune_fraction, device=device),
        size=size_given(size),
        min_visible=min_visible,
        box_margin=box_margin,
        seed=seed,
        value_range=range_given(value_range),
        source=source,
        onnx=onnx,
    )
    trained = calls.train(model_or_run, real, labels, out, options, workers=workers)
    show_scores(trained, Console(highlight=False))
    print(f"The detector is in {out}")
    return command_line("predict", out, "PHOTOS", "--out", "predicted.json")


@command()
def predict(
    detector: Annotated[Path, typer.Argument(metavar="DETECTOR", help="Folder that 'probscene train' wrote.")],
    photos: Annotated[list[Path], typer.Argument(metavar="PHOTOS", help="Photographs, or folders of them.")],
    out: Annotated[Path, typer.Option(metavar="PATH", help="JSON file to write; for YOLO a new folder.")],
    format: Annotated[str, typer.Option(metavar="FORMAT", help="coco or yolo.")] = "coco",
    min_score: Annotated[
        float | None,
        typer.Option(metavar="X", help="Lowest score to write; that of fewest errors if not given."),
    ] = None,
    overlays: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Also draw the detections on each photograph.")
    ] = None,
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave out images that do not decode.")] = False,
    device: Device = "cpu",
) -> str:
    """Label photographs with a trained detector."""
    from rich.console import Console

    from ..api import calls
    from ..detectors.folder import TrainedDetector
    from ..detectors.tables import show_predictions

    trained = TrainedDetector.at(detector, device)
    found = calls.predict(trained, photos, out, format, min_score=min_score, overlays=overlays, skip_bad=skip_bad)
    show_predictions(found, Console(highlight=False))
    print(f"The labels are in {out}" + (f", the pictures in {overlays}" if overlays is not None else ""))
    if overlays is None:
        return f"{command_line('predict', detector, *photos, '--out', out, '--overlays', 'DIR')}, to see them."
    return f"label the photographs that {overlays / 'label_next.txt'} lists, and train again with them."
