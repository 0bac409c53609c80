"""``probscene trial``: what a labelled set is worth to a detector."""

from pathlib import Path
from typing import Annotated

import typer

from probscene.errors import ProbsceneError

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
def trial(
    *,
    test: Annotated[Path, typer.Option(metavar="PATH", help="Labelled photographs to test on; PATH@LIST for some.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    hold_out: Annotated[
        int | None, typer.Option(metavar="N", help="Test on N photographs of --test only, and train on the others.")
    ] = None,
    run: Annotated[Path | None, typer.Option(metavar="RUN", help="Fit to generate training images with.")] = None,
    real: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Labelled photographs to train on, instead of --hold-out.")
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=SET",
            help="Training set: PATH, PATH:N, real:N, learnt, A,B (B after A) or A+B (mixed); repeat for more.",
        ),
    ] = None,
    generate: Annotated[int, typer.Option(metavar="N", help="Images to generate for each set.")] = 600,
    seeds: Annotated[int, typer.Option(metavar="N", help="Trainings of each set.")] = 5,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(metavar="N", help="Processes; the results do not depend on it.")] = 1,
    real_numbers: Annotated[
        str | None,
        typer.Option(
            metavar="N,...",
            help="Sets of so many photographs; 10,20,50,all if not given, or none.",
            rich_help_panel="Training sets",
        ),
    ] = None,
    sources: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="Of RUN: prior, start (the initialisation), structure or parameters (what was learnt of it), learnt.",
            rich_help_panel="Training sets",
        ),
    ] = "prior,start,learnt",
    classes: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="Classes to detect; all if not given.", rich_help_panel="Labels"),
    ] = None,
    min_visible: MinVisible = 0.2,
    box_margin: BoxMargin = "0",
    detector: Detector = "efficientnet",
    size: Size = None,
    iterations: Iterations = None,
    batch: Batch = None,
    rate: Rate = None,
    finetune_fraction: FinetuneFraction = 0.5,
    warm_start: Annotated[
        bool,
        typer.Option(
            "--warm-start",
            help="Initialise the detector of each set from that of the set before.",
            rich_help_panel="Detector",
        ),
    ] = False,
    baseline: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Set to compare with; the first if not given; repeat for more.",
            rich_help_panel="Comparison",
        ),
    ] = None,
    resamples: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Bootstrap resamples, for intervals.",
            rich_help_panel="Comparison",
        ),
    ] = 1000,
    value_range: ValueRange = None,
    device: Device = "cpu",
) -> str:
    """Compare training sets by the detectors that are trained on them."""
    from rich.console import Console

    from ..api import calls
    from ..trial.tables import show
    from ..trial.trial import GeneratedSets, TrainingBudget, TrialOptions

    named: dict[str, str | Path] = {}
    for words in sets or []:
        name, equals, said = words.partition("=")
        if not equals or not said:
            raise ProbsceneError(f"expected --set NAME=SET, got {words!r}.")
        if name.strip() in named:
            raise ProbsceneError(f"expected a name for each set of a trial, got {name.strip()!r} twice; rename one.")
        named[name.strip()] = said.strip()
    generated = None
    if run is not None:
        generated = GeneratedSets(run, tuple(words_given(sources)), generate, min_visible, box_margin)
    options = TrialOptions(
        hold_out=hold_out,
        real=real,
        numbers=None if real_numbers is None else _numbers(real_numbers),
        generated=generated,
        classes=None if classes is None else words_given(classes),
        detector=detector,
        budget=TrainingBudget(iterations, batch, rate, finetune_fraction, warm_start, device),
        size=size_given(size),
        seeds=seeds,
        seed=seed,
        baselines=baseline or (),
        resamples=resamples,
        value_range=range_given(value_range),
    )
    found = calls.trial(test, out, named, options, workers=workers)
    show(found, Console(highlight=False))
    print(f"All figures are in {out / 'results.json'}, the picture is {out / 'results.png'}")
    photos = ("PHOTOS", "--labels", "LABELS") if real is None else (real,)
    return command_line("train", run or "MODEL_OR_RUN", "--real", *photos, "--out", "DETECTOR")


def _numbers(text: str) -> list[int | None]:
    words = [] if text == "none" else words_given(text)
    if not all(word == "all" or (word.isdecimal() and int(word) > 0) for word in words):
        raise ProbsceneError(f"expected numbers of photographs such as 10,20,50,all, or none, got {text!r}.")
    return [None if word == "all" else int(word) for word in words]
