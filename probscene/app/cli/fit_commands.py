"""``probscene fit``, ``demo`` and ``version``."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

import probscene
from probscene.errors import ProbsceneError

from ..arguments import checked_seed, range_given
from .application import app
from .options import Assets, Cache, ClusterAddress, NoCache, PresetName, Seed, ValueRange


@app.command()
def fit(
    ctx: typer.Context,
    out: Annotated[Path, typer.Option(metavar="RUN", help="The run folder to write.")],
    model: Annotated[str | None, typer.Argument(metavar="MODEL", help="A built-in model or a .py file.")] = None,
    target: Annotated[Path | None, typer.Option(metavar="DIR", help="A folder of PNG, JPEG or TIFF images.")] = None,
    preset: Annotated[PresetName | None, typer.Option(help="How long to learn; 'default' if not given.")] = None,
    divergence: Annotated[
        str | None, typer.Option(metavar="NAME", help="What is descended: kde, js, witness, mmd, or FILE.py:NAME.")
    ] = None,
    guide: Annotated[
        str | None, typer.Option(metavar="NAME", help="What learns: lstm, pcfg, grammar-vae, or FILE.py:NAME.")
    ] = None,
    features: Annotated[
        str | None,
        typer.Option(
            metavar="NET",
            help="count, count=efficientnet, presence[=counts], efficientnet, inception[=FILE], resnet50[=FILE], "
            "FILE.py:NAME.",
        ),
    ] = None,
    learn: Annotated[
        str | None,
        typer.Option(metavar="WHAT", help="structure, or structure,parameters: where things stand and how they look."),
    ] = None,
    parameters: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="How the latter are learnt: likelihood; tilting, for photographs; or meta-sim, a baseline.",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Another value of it, such as structure.batches=40."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="The same seed gives the same result; 0 if not given.")] = None,
    skip_bad: Annotated[bool | None, typer.Option("--skip-bad", help="Leave out files that do not decode.")] = None,
    threads: Annotated[int | None, typer.Option(help="As OMP_NUM_THREADS says if not given, else all cores.")] = None,
    scenarios: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="Of a model that has several; a guide learns each. All if not given."),
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH", help="Of a few of the images: a counts.csv, COCO's .json, KITTI's label_2, YOLO's labels."
        ),
    ] = None,
    assets: Assets = None,
    cache: Cache = None,
    no_cache: NoCache = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was interrupted.")] = False,
    no_verdict: Annotated[bool, typer.Option("--no-verdict", help="Do not judge the fit at its end.")] = False,
    cluster: ClusterAddress = None,
    value_range: ValueRange = None,
) -> None:
    """Learn which structures occur in a folder of unlabelled images, and say how near that came."""
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
    images = TargetImages(target, skip_bad, range_given(value_range))
    request = fit_request(ModelFile(source, assets), images, config, seed, labels, threads)
    execution = Execution(threads, cluster, False if no_cache else cache or True)
    try:
        done = fit_and_diagnose(request, out, resume, execution, not no_verdict)
    except BaseException:
        if not resume and (out / "run.json").exists():
            ctx.obj.words.append("--resume")  # what the message says to run again
        raise
    if done.diagnostics is not None:
        show_parts(done.diagnostics.record(), Console(highlight=False))
    print(f"Learnt. Look at it with: probscene report {shlex.quote(str(out))}")


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write.")] = Path("demo"),
    seed: Seed = 0,
    cache: Cache = None,
    no_cache: NoCache = False,
) -> None:
    """The whole path on handwritten digits that come with the install; about a quarter of an hour on two cores."""
    from ..api.demo import demo
    from ..fitting.pipeline import Execution

    demo(out, checked_seed(seed), execution=Execution(cache=False if no_cache else cache or True))


@app.command()
def version() -> None:
    """Print the version."""
    print(f"probscene {probscene.__version__}")
