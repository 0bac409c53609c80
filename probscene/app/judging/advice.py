"""What to do about layout and looks that are not good: by what was learnt, what was not read, and how sure it is."""

from typing import Any

from probscene.inference.judging.nearness import CLEARLY, Nearness, Word

from ..fitting.preset import BOTH, LIKELIHOOD, META_SIM, TILTING
from ..fitting.run import RunFolder

PHOTO = (
    "Put scene.photo(...), with light, colour, focus and noise, into the model, or sprites and textures nearer to the "
    "images."
)
LONGER = {
    LIKELIHOOD: "Fit longer: the default preset, or --set parameters.steps and parameters.rounds.",
    TILTING: "Fit longer: --set tilting.rounds and tilting.scenes.",
    META_SIM: "Fit longer: --set meta_sim.steps.",
}
NONE = {
    LIKELIHOOD: "Train the reader longer: the default preset, or --set parameters.reader_steps.",
    TILTING: "Give the model sites of the whole scene that images show.",
    META_SIM: "Give the model continuous sites.",
}
FARTHER = 2.0  # floors, from which on a site is named
UNSURE = 0.7  # of the distance is left, and it is not sure that it is less than all


def remedy(run: RunFolder, part: str, word: Word, figures: Nearness) -> str:
    """What to do about ``layout`` or ``looks``, in a few sentences."""
    if word is Word.GOOD:
        return "Use it."
    said = [_learn(run), _unread(run.parameters), _far(run.parameters)]
    said += [PHOTO] if part == "looks" else []
    if figures.left is not None and figures.left < UNSURE and figures.high > CLEARLY:
        said.append("More photographs would make it surer.")
    return " ".join(filter(None, said))


def _learn(run: RunFolder) -> str:
    """How parameters are learnt, or better."""
    record = run.parameters
    if not record:
        if run.preset.learn != BOTH:
            return f"Learn parameters, too: fit again with --learn {BOTH}."
        return f"These features read no parameters: fit again with --features count, or --parameters {TILTING}."
    if not any(site["learnt"] for site in record["sites"]):
        return NONE[record.get("method", LIKELIHOOD)]
    if record["kept"] != "learnt":
        return (
            "What was learnt came no nearer to held-out images, and is unused: take the default preset or more images."
        )
    return LONGER[record.get("method", LIKELIHOOD)]


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
