"""What to do about parts of a fit that are not good: by what was learnt, what was not read, and how sure it is."""

from typing import Any

from probscene.inference.statistics.residual import CLEARLY, Grade, ResidualRatio
from probscene.inference.statistics.trust import Trust
from probscene.inference.statistics.verdict import Verdict

from ..fitting.config import BOTH, LIKELIHOOD, META_SIM, TILTING
from ..fitting.run import RunFolder

PHOTO = (
    "Put scene.photo(...), with light, colour, focus and noise, into the model, or sprites and textures nearer to the "
    "images."
)
LONGER = {
    LIKELIHOOD: ("parameters.steps", "parameters.rounds"),
    TILTING: ("parameters.rounds", "parameters.scenes"),
    META_SIM: ("parameters.steps",),
}
NONE = {
    TILTING: "Give the model sites of the whole scene that images show.",
    META_SIM: "Give the model continuous sites.",
}
READER = ("parameters.reader_steps",)
FARTHER = 2.0  # floors, from which on a site is named
UNSURE = 0.7  # of the distance is left, and it is not sure that it is less than all


def of_structure(run: RunFolder, found: Trust) -> str:
    """What to do about structure, in a few sentences."""
    if found.verdict is Verdict.NOT_FITTED:
        return f"The guide still makes what the prior makes. {longer(run, ('structure.batches',))}"
    if found.verdict is Verdict.APART:
        return f"{longer(run, ('structure.batches',))} Where a class is read wrongly that does not help: {label(run)}."
    return found.remedy


def label(run: RunFolder) -> str:
    """What to do about classes that are read wrongly in the target's images: label some."""
    if "labels" in run.record:
        return "label more images than this fit had (probscene label), and fit again with all of them"
    return "label ten images (probscene label), and fit again with --labels"


def longer(run: RunFolder, names: tuple[str, ...]) -> str:
    """To take twice as much of some settings, by their paths."""
    settings = run.config.flat()
    had = [settings[name] for name in names]
    words = " ".join(f"--set {name}={max(1, 2 * value)}" for name, value in zip(names, had, strict=True))
    return f"Fit again for longer, such as twice the {' and '.join(map(str, had))} of this fit: {words}."


def remedy(run: RunFolder, part: str, word: Grade, figures: ResidualRatio, would_tell: str) -> str:
    """What to do about ``layout`` or ``looks``, in a few sentences.

    Args:
        would_tell: what would make the comparison surer.
    """
    if word is Grade.GOOD:
        return "Use it."
    said = [_learn(run), _unread(run.parameters), _far(run.parameters)]
    said += [PHOTO] if part == "looks" else []
    if figures.left is not None and figures.left < UNSURE and figures.high > CLEARLY:
        said.append(would_tell)
    return " ".join(filter(None, said))


def _learn(run: RunFolder) -> str:
    """How parameters are learnt, or better."""
    record = run.parameters
    method = record.get("method", LIKELIHOOD)
    if not record:
        if run.config.parameters is None:
            return f"Learn parameters, too: fit again with --learn {BOTH}."
        return f"These features read no parameters: fit again with --features count, or --parameters {TILTING}."
    if not any(site["learnt"] for site in record["sites"]):
        if method == LIKELIHOOD:
            return f"The reader reads no site. {longer(run, READER)}"
        return NONE[method]
    if record["kept"] != "learnt":
        return (
            "What was learnt came no nearer to held-out images, and is unused: take the default preset or more images."
        )
    return longer(run, LONGER[method])


def _unread(record: dict[str, Any]) -> str:
    names = [site["name"] for site in record.get("sites", []) if not site["learnt"]]
    if not names:
        return ""
    what = "Set the priors of these by hand, or write the program so that images show them."
    return f"Not learnt: {', '.join(names)}. {what}"


def _far(record: dict[str, Any]) -> str:
    """Learnt sites whose readings are still far from the target's, the farthest first."""
    if record.get("kept") != "learnt":
        return ""
    found = []
    for site in record["sites"]:
        apart = site.get("read", {}).get("distance")
        if site["learnt"] and apart and apart["learnt"] > FARTHER * apart["floor"]:
            found.append((apart["learnt"], f"{site['name']} ({apart['learnt']:.3f}, floor {apart['floor']:.3f})"))
    said = ", ".join(text for _, text in sorted(found, reverse=True))
    return f"Farthest from what is read in the target: {said}." if said else ""
