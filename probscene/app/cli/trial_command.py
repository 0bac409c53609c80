"""``probscene trial``: what is a labelled set worth to a detector?"""

from pathlib import Path
from typing import Annotated

import typer

from probscene.errors import ProbsceneError

from ..arguments import range_given, size_given, words_given
from .application import app
from .options import BoxMargin, Seed, ValueRange


@app.command()
def trial(
    test: Annotated[
        Path, typer.Option(metavar="PATH", help="Labelled real images: COCO, KITTI or YOLO; PATH@LIST for some.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write.")],
    sets: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=SET",
            help="PATH, PATH:N, A,B (B after A), A+B (mixed), real:N, learnt; again for more.",
        ),
    ] = None,
    hold_out: Annotated[
        int | None, typer.Option(metavar="N", help="Test on N images of --test alone; the others are 'real'.")
    ] = None,
    real: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Labelled photographs to train on, where not by --hold-out.")
    ] = None,
    real_numbers: Annotated[
        str | None, typer.Option(metavar="N,...", help="Sets of so many of them; 10,20,50,all if not given, or none.")
    ] = None,
    run: Annotated[Path | None, typer.Option(metavar="RUN", help="A fit of which sets are generated.")] = None,
    sources: Annotated[
        str, typer.Option(metavar="NAME,...", help="Which of its sets: prior, start (of pretraining), learnt.")
    ] = "prior,start,learnt",
    generate: Annotated[int, typer.Option(metavar="N", help="How many images of each.")] = 600,
    min_visible: Annotated[
        float, typer.Option(metavar="FRACTION", help="No label there for objects of which less is visible.")
    ] = 0.2,
    box_margin: BoxMargin = 0,
    classes: Annotated[
        str | None, typer.Option(metavar="NAME,...", help="What it is about; all classes if not given.")
    ] = None,
    detector: Annotated[str, typer.Option(metavar="NET", help="efficientnet or maskrcnn=FILE.")] = "efficientnet",
    iterations: Annotated[
        int | None, typer.Option(metavar="N", help="Steps of a training; 600, of maskrcnn 5000.")
    ] = None,
    batch: Annotated[int | None, typer.Option(metavar="N", help="Images a step; 4, of maskrcnn 2.")] = None,
    rate: Annotated[float | None, typer.Option(metavar="X", help="Of Adam; the detector's if not given.")] = None,
    finetune_fraction: Annotated[
        float, typer.Option(metavar="FRACTION", help="Of the images of a training, for the last of A,B.")
    ] = 0.5,
    warm_start: Annotated[
        bool, typer.Option("--warm-start", help="Each set starts from the detector of the set before.")
    ] = False,
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Images come so large; about 256x192 if not given.")
    ] = None,
    seeds: Annotated[int, typer.Option(metavar="N", help="Trainings of each set.")] = 5,
    seed: Seed = 0,
    baseline: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Compare the sets with this one; the first if not given.")
    ] = None,
    resamples: Annotated[int, typer.Option(metavar="N", help="Of test images and seeds, for intervals.")] = 1000,
    workers: Annotated[int, typer.Option(metavar="W", help="Processes; the results do not depend on it.")] = 1,
    value_range: ValueRange = None,
) -> None:
    """Say what labelled sets are worth: train one detector on each, test it on labelled real images."""
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
        budget=TrainingBudget(iterations, batch, rate, finetune_fraction, warm_start),
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


def _numbers(text: str) -> list[int | None]:
    words = [] if text == "none" else words_given(text)
    if not all(word == "all" or (word.isdecimal() and int(word) > 0) for word in words):
        raise ProbsceneError(f"expected numbers of photographs such as 10,20,50,all, or none, got {text!r}.")
    return [None if word == "all" else int(word) for word in words]
