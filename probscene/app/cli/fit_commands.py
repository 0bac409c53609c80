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
    objective: Annotated[
        str | None, typer.Option(metavar="NAME", help="The divergence: kde, js, witness, mmd, or FILE.py:NAME.")
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
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Another value of a preset's field.")
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

    from ..api.fit import chosen_preset, preset_for_photographs, with_learn
    from ..evaluation.diagnose import diagnose
    from ..evaluation.evaluate import warn_of_saturated_lists
    from ..fitting import session
    from ..fitting.pipeline import open_target
    from ..loading import split_reference
    from ..progress import Display
    from ..views.verdict_text import show_parts
    from ..workers.cluster import connected

    if seed is not None:
        checked_seed(seed)
    chosen_range = range_given(value_range)
    name = str(preset or PresetName.default)
    settings = with_learn(settings or [], learn, parameters)
    chosen, parts = chosen_preset(name, features, objective, guide, settings)
    other = preset_for_photographs(name, features, objective, guide, settings)
    if scenarios is not None:
        if model is None:
            raise ProbsceneError("expected MODEL with --scenarios, got none; a run knows its own.")
        if split_reference(model)[1]:
            raise ProbsceneError(f"expected scenarios once, got {model} and {scenarios}; leave out --scenarios.")
        model = f"{model}:{scenarios}"
    judged = None
    with Display() as show:
        with connected(cluster, show.say) as nodes:  # first, so that a wrong address leaves no run behind
            if resume:
                given = chosen if preset or objective or guide or features or settings else None
                begun = {"seed": seed, "skip_bad": skip_bad, "threads": threads, "labels": labels}
                begun["value_range"] = chosen_range
                run, images = session.resume(out, show, model, target, given, assets, parts, photographs=other, **begun)
            elif model is None or target is None:
                raise ProbsceneError(
                    "expected MODEL and --target DIR, got one missing; only --resume goes without them."
                )
            else:
                run, images = session.begin(
                    model,
                    target,
                    out,
                    chosen,
                    seed or 0,
                    bool(skip_bad),
                    threads,
                    show,
                    assets,
                    parts,
                    labels=labels,
                    photographs=other,
                    value_range=chosen_range,
                )
                ctx.obj.words.append("--resume")
            unfinished = not run.is_finished
            if unfinished:
                session.carry_out(run, images, show, cache, not no_cache, nodes)
        if unfinished:
            warn_of_saturated_lists(run, show)
            if not no_verdict:
                judged = diagnose(run, images or open_target(run, show), show)
    if judged is not None:
        show_parts(judged.record(), Console(highlight=False))
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

    demo(out, checked_seed(seed), cache=cache, use_cache=not no_cache)


@app.command()
def version() -> None:
    """Print the version."""
    print(f"probscene {probscene.__version__}")
