"""``probscene fit``, ``demo`` and ``version``."""

import sys
from pathlib import Path
from typing import Annotated

import typer

import probscene
from probscene.errors import ProbsceneError

from ..arguments import checked_seed, range_given
from .application import command, command_line
from .options import Assets, Cache, ClusterAddress, NoCache, PresetName, Seed, ValueRange


@command()
def fit(
    ctx: typer.Context,
    *,
    model: Annotated[str | None, typer.Argument(metavar="MODEL", help="Built-in model or .py file.")] = None,
    target: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of unlabelled images: PNG, JPEG or TIFF.")
    ] = None,
    out: Annotated[Path, typer.Option(metavar="RUN", help="Run folder to write.")],
    preset: Annotated[
        PresetName | None,
        typer.Option(metavar="NAME", help="quick, default (if not given), street, paper, paper-aerial, paper-driving."),
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="A few labels: counts.csv, COCO .json, KITTI label_2 or YOLO labels."),
    ] = None,
    readings: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Detections in all images, with scores: COCO .json."),
    ] = None,
    learn: Annotated[
        str | None,
        typer.Option(metavar="WHAT", help="structure, or structure,parameters (position and appearance)."),
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Random seed; 0 if not given.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One setting, such as structure.batches=40; repeat for more."),
    ] = None,
    skip_bad: Annotated[bool | None, typer.Option("--skip-bad", help="Leave out images that do not decode.")] = None,
    no_verdict: Annotated[bool, typer.Option("--no-verdict", help="Do not judge the fit.")] = False,
    detector_test: Annotated[
        bool,
        typer.Option(
            "--detector-test", help="Compare prior and fit by detectors; parameters that are worse are undone."
        ),
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
    features: Annotated[
        str | None,
        typer.Option(
            metavar="NET",
            help="Feature network: count, count=efficientnet, presence[=counts], efficientnet, inception[=FILE], "
            "resnet50[=FILE] or FILE.py:NAME.",
            rich_help_panel="Method",
        ),
    ] = None,
    parameters: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Learning of parameters: likelihood, tilting (photographs) or meta-sim.",
            rich_help_panel="Method",
        ),
    ] = None,
    divergence: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Divergence to minimise: kde, js, witness, mmd or FILE.py:NAME.",
            rich_help_panel="Method",
        ),
    ] = None,
    guide: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Distribution over structures: lstm, pcfg, grammar-vae or FILE.py:NAME.",
            rich_help_panel="Method",
        ),
    ] = None,
    scenarios: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...", help="Scenarios of the model to use; all if not given.", rich_help_panel="Method"
        ),
    ] = None,
    value_range: ValueRange = None,
    assets: Assets = None,
    threads: Annotated[
        int | None,
        typer.Option(metavar="N", help="OMP_NUM_THREADS, or all cores, if not given.", rich_help_panel="Computing"),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help="Where networks compute: cpu (if not given), cuda, cuda:1, mps or auto.",
            rich_help_panel="Computing",
        ),
    ] = None,
    cluster: ClusterAddress = None,
    cache: Cache = None,
    no_cache: NoCache = False,
) -> str:
    """Fit a model to a folder of unlabelled images, and judge the fit."""
    from rich.console import Console

    from ..api.fit import DEFAULT, fit_and_diagnose, fit_request
    from ..fitting.begin import ModelFile
    from ..fitting.config import configuration, parameter_choice
    from ..fitting.pipeline import Execution
    from ..fitting.presets import preset as named
    from ..loading import with_scenarios
    from ..targets import TargetImages
    from ..views.verdict_text import show_parts

    config, method = None, parameter_choice(learn, parameters)
    if not resume or preset is not None or any((features, divergence, guide, method, settings)):
        config = configuration(named(str(preset or DEFAULT)), features, divergence, guide, method, settings or [])
    if model is None and scenarios is not None:
        raise ProbsceneError("expected MODEL with --scenarios, got none; a run knows its own.")
    source = None if model is None else with_scenarios(model, scenarios)
    images = TargetImages(target, skip_bad, range_given(value_range), readings)
    request = fit_request(ModelFile(source, assets), images, config, seed, labels, threads)
    execution = Execution(threads, cluster, False if no_cache else cache or True, device=device)
    try:
        done = fit_and_diagnose(request, out, resume, execution, not no_verdict, detector_test)
    except BaseException:
        if not resume and (out / "run.json").exists():
            ctx.obj.words.append("--resume")  # what the message says to run again
        raise
    if done.diagnostics is not None:
        show_parts(done.diagnostics.record(), Console(highlight=False))
    return command_line("report", out)


@command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")] = Path("demo"),
    full: Annotated[bool, typer.Option("--full", help="Up to ten digits, longer; a quarter of an hour.")] = False,
    seed: Seed = 0,
    cache: Cache = None,
    no_cache: NoCache = False,
) -> str:
    """Run the whole method on handwritten digits, in two minutes."""
    print(f"Learning from digits in {'a quarter of an hour' if full else 'two minutes'}. All that is made is in {out}.")
    sys.stdout.flush()
    from rich.console import Console

    with Console(stderr=True).status("Importing PyTorch"):  # which takes seconds
        from ..api.demo import FULL, TWO_MINUTES, demo
        from ..fitting.pipeline import Execution

    # One thread: what is trained is so small that two gain little, and lose much where another process has a core.
    execution = Execution(threads=1, cache=False if no_cache else cache or True)
    demo(out, checked_seed(seed), size := FULL if full else TWO_MINUTES, execution)
    print("\nTry:")
    for words in (
        ("generate", out / "run", "--num", 2000, "--out", "digits"),
        ("fit", size.model, "--target", out / "target" / "images", "--preset", "quick", "--out", "runs/longer"),
        ("preview", "driving", "--out", "streets.png"),
    ):
        print(f"  {command_line(*words)}")
    return command_line("begin", "PHOTOS", "--labels", "LABELS", "--out", "DIR")


@command()
def version() -> None:
    """Print the version."""
    print(f"probscene {probscene.__version__}")
