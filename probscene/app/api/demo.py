"""``probscene demo``: the whole path on a target that the model itself draws.

    target/images    the target; fitting sees nothing else
    truth.csv        what is in it, for judging only
    run              the fit, with report.html
    dataset          labelled images of what was learnt
    evaluation.json  how near that is to the truth
    grid.png         prior, learnt structure alone, all that was learnt, and target side by side

Each step is left out where it is finished, so the same command goes on after an interruption.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from probscene.dataset import Images
from probscene.errors import ModelError
from probscene.model import SceneModel

from ..datasets.generate import generate, generate_scenes
from ..evaluation.diagnose import NUM_SCENES, diagnose
from ..evaluation.evaluate import evaluate
from ..evaluation.labels import counts_of_dataset, read_labels
from ..evaluation.source_features import LEARNT, PRIOR, STRUCTURE, policies
from ..files import make_folder, write_json
from ..fitting.config import FitConfig
from ..fitting.pipeline import Execution
from ..fitting.presets import QUICK
from ..fitting.run import RunFolder
from ..fitting.store import timing
from ..labels.counts import write_counts
from ..loading import load_model
from ..pictures import pixels, side_by_side, write_picture
from ..progress import Display
from ..targets import open_images
from ..views import report, tables, verdict_text
from ..views.preview import scenes as preview
from .fit import carried_out, fit_request

SAMPLES = 16  # images a grid


@dataclass(frozen=True)
class DemoSize:
    """How much a demo does.

    Args:
        model: with a target to learn from.
        config: of the fit.
        images: of the target.
        generated: of the dataset.
        judged: scenes that the verdict looks at.
    """

    model: str
    config: FitConfig
    images: int
    generated: int
    judged: int


TWO_MINUTES = DemoSize(
    "small_digits",
    QUICK.set(
        {
            "features": "count",
            "features.schedule.steps": 500,
            "structure.batches": 60,
            "structure.num_scenes": 200,
            "structure.draws_per_structure": 2,
            "pretrain.derivations": 1000,
            "parameters.images": 400,
            "parameters.reader_steps": 200,
            "parameters.reader_images": 8,
            "parameters.steps": 120,
            "parameters.step_images": 40,
            "parameters.rounds": 1,
            "parameters.round_reader_steps": 80,
            "parameters.round_steps": 60,
            "refine.batches": 20,
        }
    ),
    images=800,
    generated=200,
    judged=400,
)
FULL = DemoSize("multi_mnist", QUICK, images=3000, generated=500, judged=NUM_SCENES)


def demo(out: Path, seed: int = 0, size: DemoSize = TWO_MINUTES, execution: Execution | None = None) -> None:
    """Draw a target, fit, generate, evaluate, report; prints how near it came and where to look.

    Args:
        seed: of the target's distribution as well as of the fit.
        execution: of the fit.

    Raises:
        ProbsceneError: a model without a target, or a folder that holds something else.
    """
    loaded, execution = load_model(size.model), execution or Execution()
    if loaded.target is None:
        raise ModelError(f"expected a model with a target to learn from, got {size.model!r}, which has none.")
    out = make_folder(out)
    with Display() as show:
        target = _draw(loaded.target(seed), size.images, out, seed, show)
        request = fit_request(size.model, target, size.config, seed, None, execution.threads)
        done = carried_out(request, out / "run", show, (out / "run" / "run.json").exists(), execution)
        run, opened = done.run, done.images
        generate(run, size.generated, out / "dataset", seed, progress=show.stage("generating"))
        if not all((out / name).exists() for name in ("evaluation.json", "grid.png", "run/report.html")):
            _judge(run, opened or open_images(target, loaded, False, show), size.judged, out, show)
    console = Console(highlight=False)
    measured = json.loads((out / "evaluation.json").read_text(encoding="utf-8"))
    for table in tables.distance_tables({"truth": measured["distances"]["truth"]}):
        console.print(table)
    print("\nWithout labels:")
    verdict_text.show_parts(measured["trust"], console)
    spent = sum(timing(run).values())
    print(f"\nFitting took {spent:.0f} s and saw only {target}. Where to look:")
    for name, what in (
        ("grid.png", "scenes of the prior, of learnt structure alone, of all that was learnt, and of the target"),
        ("run/report.html", "the report: histograms, learning curves, configuration"),
        ("dataset", f"{size.generated} labelled images: images/, annotations.json (COCO), provenance.jsonl"),
        ("truth.csv", "what the target holds, for judging only"),
    ):
        print(f"  {out / name!s:<24} {what}")


def _draw(truth: SceneModel, images: int, out: Path, seed: int, show: Display) -> Path:
    """The folder of the target's images, with its counts beside it."""
    folder = out / "target"
    generate_scenes(truth, truth.prior, images, folder, seed, "images", show.stage("drawing"))
    if not (out / "truth.csv").exists():
        write_counts(out / "truth.csv", *counts_of_dataset(truth, folder), truth.classes)
    return folder / "images"


def _judge(run: RunFolder, target: Images, scenes: int, out: Path, show: Display) -> None:
    model = run.model
    found = evaluate(run, target, read_labels(out / "truth.csv", model, target), show)
    judged = diagnose(run, target, show, scenes, found)
    write_json(out / "evaluation.json", found.record() | {"trust": judged.record()})
    report.write(run, found, target, diagnostics=judged)
    sources = policies(run)
    panels = {"Prior": PRIOR, "Structure alone": STRUCTURE, "Learnt": LEARNT}
    if STRUCTURE not in sources:
        del panels["Structure alone"]
    pictures = {
        caption: pixels(preview(model, sources.get(name, model.prior), SAMPLES, 0).image)
        for caption, name in panels.items()
    }
    pictures["Target"] = [pixels(target.load(i)[None])[0] for i in range(min(SAMPLES, len(target)))]
    write_picture(out / "grid.png", side_by_side(pictures))
