"""``probscene``: the command line. Commands import what they need when they run, so that ``--help`` is quick.

Exit codes: 0; 2 where the input is at fault; 1 where the machine is, where the work was interrupted, and for a bug.
"""

import os
import shlex
import sys
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperGroup

import probscene
from probscene.errors import ModelError, ProbsceneError

from .memory import keep_freed_memory

if TYPE_CHECKING:
    from .fitting.presets import Preset


@dataclass
class Call:
    """What was asked for, for the message when it ends early."""

    words: list[str]
    debug: bool = field(default_factory=lambda: bool(os.environ.get("PROBSCENE_DEBUG")))


class Commands(TyperGroup):
    """Turns an error of any command into one line on stderr and an exit code."""

    def parse_args(self, ctx, args):
        ctx.obj = Call(list(args))
        return super().parse_args(ctx, args)

    def invoke(self, ctx):
        try:
            return super().invoke(ctx)
        except (Exception, KeyboardInterrupt) as error:
            its_own = type(error).__module__.startswith(("typer.", "click."))  # wrong usage, --help, an exit code
            if its_own or isinstance(error, BrokenPipeError) or ctx.obj.debug:
                raise
            code, text = explained(error, ctx.obj.words)
            print(text, file=sys.stderr)
        raise typer.Exit(code)


def explained(error: BaseException, words: list[str]) -> tuple[int, str]:
    """The exit code and the one line that an error comes to; ``words`` are what was typed after ``probscene``."""
    again = shlex.join(["probscene", *words])
    if isinstance(error, KeyboardInterrupt):
        return 1, f"Interrupted; go on with: {again}"
    if isinstance(error, OSError):
        from .files import machine_error

        error = machine_error(error, Path(error.filename or "the output"))
    if isinstance(error, ProbsceneError):
        return error.exit_code, f"probscene: {' '.join(str(error).split())}"
    if isinstance(error, MemoryError):
        return 1, "probscene: The machine is out of memory; close other programs and run the command again."
    last = (str(error).strip().splitlines() or ["no message"])[-1]
    debug = shlex.join(["probscene", "--debug", *words])
    return 1, f"probscene: A bug in probscene: {type(error).__name__}: {last}. Please report what this prints: {debug}"


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="A run folder, made by 'probscene fit'.")]
Model = Annotated[str, typer.Argument(metavar="MODEL", help="multi_mnist, aerial2d, driving, or a .py file.")]
Seed = Annotated[int, typer.Option(help="The same seed gives the same result.")]
Assets = Annotated[
    Path | None, typer.Option(metavar="DIR", help="A folder of meshes (driving) or pictures (aerial2d) to draw with.")
]
MinHeight = Annotated[float, typer.Option(min=0, help="Of objects that KITTI's labels count, pixels of their boxes.")]
PresetName = StrEnum("PresetName", ["quick", "default", "paper", "street"])
Objective = StrEnum("Objective", ["kde", "js", "witness", "mmd"])
GuideName = StrEnum("GuideName", {"lstm": "lstm", "pcfg": "pcfg", "grammar_vae": "grammar-vae"})


@app.callback()
def _everywhere(
    ctx: typer.Context, debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False
) -> None:
    """Learn which scene structures occur in unlabelled images, then generate a labelled dataset that has them."""
    ctx.obj.debug |= debug


@app.command()
def check(model: Model, assets: Assets = None) -> None:
    """Say whether a model's grammar is sound, how long its derivations are, and what to mend."""
    from probscene.checks import check

    from .loading import load_model

    report = check(load_model(model, assets))
    print(report)
    if report.faults:
        raise ModelError(f"Expected a model without faults, actual {model} with {len(report.faults)}; mend them first.")


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
    from .views.preview import preview

    preview(model_or_run, out, num, _seed(seed), boxes, assets)
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
    from .views.export import view

    view(model_or_run, out, num, _seed(seed), assets)
    print(f"{num} {'scene' if num == 1 else 'scenes'} in {out}")


@app.command()
def fit(
    ctx: typer.Context,
    out: Annotated[Path, typer.Option(metavar="RUN", help="The run folder to write.")],
    model: Annotated[str | None, typer.Argument(metavar="MODEL", help="A built-in model or a .py file.")] = None,
    target: Annotated[Path | None, typer.Option(metavar="DIR", help="A folder of PNG or JPEG images.")] = None,
    preset: Annotated[PresetName | None, typer.Option(help="How long to learn; 'default' if not given.")] = None,
    objective: Annotated[Objective | None, typer.Option(help="The divergence, instead of the preset's.")] = None,
    guide: Annotated[GuideName | None, typer.Option(help="What learns the rules; 'lstm' if not given.")] = None,
    features: Annotated[
        str | None,
        typer.Option(
            metavar="NET",
            help="count, count=efficientnet, presence, efficientnet, inception[=FILE] or resnet50[=FILE].",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Another value of a preset's field.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="The same seed gives the same result; 0 if not given.")] = None,
    skip_bad: Annotated[bool | None, typer.Option("--skip-bad", help="Leave out files that do not decode.")] = None,
    threads: Annotated[int | None, typer.Option(help="All cores if not given.")] = None,
    scenarios: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="Of a model that has several; a guide learns each. All if not given."),
    ] = None,
    assets: Assets = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was interrupted.")] = False,
) -> None:
    """Learn which structures occur in a folder of unlabelled images."""
    from .fitting import session
    from .loading import split_reference
    from .progress import Display

    if seed is not None:
        _seed(seed)
    if threads is not None and threads < 1:
        raise ProbsceneError(f"Expected a positive number of threads, actual {threads}.")
    chosen = _preset(preset, objective, guide, features, settings or [])
    if scenarios is not None:
        if model is None:
            raise ProbsceneError("Expected MODEL with --scenarios, actual none; a run knows its own.")
        if split_reference(model)[1]:
            raise ProbsceneError(f"Expected scenarios once, actual {model} and {scenarios}; leave out --scenarios.")
        model = f"{model}:{scenarios}"
    with Display() as show:
        if resume:
            given = chosen if preset or objective or guide or features or settings else None
            settings = {"seed": seed, "skip_bad": skip_bad, "threads": threads}
            run, images = session.resume(out, show, model, target, given, assets, **settings)
        elif model is None or target is None:
            raise ProbsceneError(
                "Expected MODEL and --target DIR, actual one missing; only --resume goes without them."
            )
        else:
            run, images = session.begin(model, target, out, chosen, seed or 0, bool(skip_bad), threads, show, assets)
            ctx.obj.words.append("--resume")
        if not run.is_finished:
            session.carry_out(run, images, show)
    print(f"Learnt. Look at it with: probscene report {shlex.quote(str(out))}")


@app.command()
def generate(
    run: RunFolder,
    num: Annotated[int, typer.Option(metavar="N", help="How many images.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write.")],
    format: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FORMAT",
            help="coco (if not given), yolo, kitti, webdataset, or images for no labels; again for more.",
        ),
    ] = None,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(metavar="W", help="Processes; the bytes do not depend on it.")] = 1,
) -> None:
    """Write a labelled dataset of the learnt structures; the same command goes on after an interruption."""
    from .datasets.generate import generate
    from .fitting.run import RunFolder
    from .progress import Display

    with Display() as show:
        dataset = generate(RunFolder.at(run), num, out, seed, workers, format or "coco", show.stage("generating"))
    print(f"{num} images in {dataset.path}, {dataset.made} of them made now")


@app.command()
def evaluate(
    run: RunFolder,
    target: Annotated[Path, typer.Option(metavar="DIR", help="The images to judge by.")],
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH", help="A counts.csv (image,CLASS,...), a provenance.jsonl, or KITTI's folder label_2."
        ),
    ] = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write all figures there, too.")] = None,
    num: Annotated[int, typer.Option(help="How many structures are sampled.")] = 10000,
    features: Annotated[
        list[str] | None,
        typer.Option(metavar="NET", help="FID and KID by run, efficientnet, inception[=FILE], resnet50[=FILE]; many."),
    ] = None,
    num_images: Annotated[int, typer.Option("--images", help="At most so many a side for FID and KID.")] = 1000,
    scenes: Annotated[int, typer.Option(help="Rendered of prior and guide for the verdict; 0 for none.")] = 1000,
    some_labels: Annotated[bool, typer.Option("--some-labels", help="Labels need not cover all images.")] = False,
    min_height: MinHeight = 0.0,
) -> None:
    """Say whether a fit can be trusted, and compare its structures with the truth or with what the network sees."""
    from rich.console import Console

    from .evaluation import judge as verdict
    from .evaluation.evaluate import evaluate
    from .evaluation.labels import read_labels
    from .files import make_folder, write_json
    from .fitting import session
    from .fitting.run import RunFolder
    from .progress import Display
    from .views import tables, verdict_text

    opened = RunFolder.at(run)
    opened.check_finished()
    if json is not None:
        make_folder(json.parent)
    with Display() as show:
        images = session.open_images(target, opened.model, opened.record["skip_bad"], show)
        truth = None if labels is None else read_labels(labels, opened.model, images, some_labels, min_height)
        found = evaluate(opened, images, truth, show, num, features=features or (), images=num_images)
        judged = verdict.judge(opened, images, show, scenes, found) if scenes else None
    console = Console(highlight=False)
    if judged is not None:
        verdict_text.show(judged, console)
    tables.show(found, console)
    if json is not None:
        write_json(json, found.record() | ({} if judged is None else {"trust": judged.record()}))


@app.command()
def report(
    run: RunFolder,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="report.html in the run folder if not given.")
    ] = None,
    labels: Annotated[
        Path | None, typer.Option(metavar="PATH", help="counts.csv, provenance.jsonl or label_2 of the run's target.")
    ] = None,
    num: Annotated[int, typer.Option(help="How many structures are sampled.")] = 10000,
    scenes: Annotated[int, typer.Option(help="Rendered of prior and guide for the verdict; 0 for none.")] = 1000,
) -> None:
    """Write one self-contained HTML page about a run."""
    from .fitting.run import RunFolder
    from .progress import Display
    from .views.report import report

    with Display() as show:
        path = report(RunFolder.at(run), show, out, labels, num, scenes)
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
        typer.Option(metavar="PATH", help="counts.csv, provenance.jsonl or label_2 of the target, for the truth."),
    ] = None,
    min_height: MinHeight = 0.0,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write all figures there, too.")] = None,
    num: Annotated[int, typer.Option(help="How many structures are sampled.")] = 10000,
) -> None:
    """Draw the prior, several runs and the truth side by side, and print how far each is from the truth."""
    from rich.console import Console

    from .evaluation import compare
    from .evaluation.labels import read_labels
    from .files import make_folder, write_json
    from .fitting import fit, session
    from .progress import Display
    from .views import comparison, tables

    opened = compare.open_runs(runs)
    comparison.make_place(out)
    first = next(iter(opened.values()))
    if json is not None:
        make_folder(json.parent)
    with Display() as show:
        images = None
        if target is not None:
            images = session.open_images(target, first.model, first.record["skip_bad"], show)
        elif labels is not None:
            images = fit.open_target(first, show)
        truth = None if labels is None else read_labels(labels, first.model, images, min_height=min_height)
        found = compare.compare(opened, images, truth, show, num)
        comparison.draw(found, out)
    tables.show_comparison(found, Console(highlight=False))
    print(f"The picture is {out}")
    if json is not None:
        write_json(json, found.record())


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write.")] = Path("demo"), seed: Seed = 0
) -> None:
    """The whole path on handwritten digits that come with the install; about five minutes on two cores."""
    from .demo import demo

    demo(out, _seed(seed))


@app.command()
def version() -> None:
    """Print the version."""
    print(f"probscene {probscene.__version__}")


def _seed(seed: int) -> int:
    if seed < 0:
        raise ProbsceneError(f"Expected a seed of 0 or more, actual {seed}.")
    return seed


def _preset(
    name: str | None, objective: str | None, guide: str | None, features: str | None, settings: list[str]
) -> "Preset":
    from .fitting.overrides import override
    from .fitting.presets import preset

    chosen = preset(str(name or PresetName.default))
    if objective is not None:
        chosen = chosen.with_objective(str(objective))
    if guide is not None:
        chosen = chosen.with_guide(str(guide))
    if features is not None:
        chosen = chosen.with_features(features)
    return override(chosen, settings)


def main() -> None:
    """The console script."""
    sys.stdout.reconfigure(errors="replace")  # a grammar's ε on a terminal that has none
    # Torch's threads wait for one another spinning, which on a machine that has other work takes six times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    keep_freed_memory()
    try:
        app(prog_name="probscene")
    except KeyboardInterrupt:  # before or after a command's work
        code, text = explained(KeyboardInterrupt(), sys.argv[1:])
        print(text, file=sys.stderr)
        sys.exit(code)


if __name__ == "__main__":
    main()
