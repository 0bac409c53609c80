"""The sentences of a verdict: why a part is graded as it is, and what to do about it.

They stand in records as well as on the screen. What is advised goes by what was learnt, which sites were not read, and
how narrow the interval is.
"""

from typing import Any

import numpy as np

from probscene.inference.parameters.sites import LEARN
from probscene.inference.statistics.residual import BETTER_RATIO, Grade, ResidualRatio
from probscene.inference.statistics.verdict import StructureVerdict, UncoveredShare, Verdict

from ..fitting.config import BOTH, LIKELIHOOD, META_SIM, TILTING
from ..fitting.run import RunFolder
from .source_features import STRUCTURE

STRUCTURE_REMEDY = {
    Verdict.GOOD: "Use the fit. Look at the images named below, and label a few to check the network's counts.",
    Verdict.MODE_COLLAPSE: "Fit again with another seed or a lower learning rate, with --divergence kde and "
    "--set structure.baseline=leave_one_out, or pretrain on a wider prior.",
    Verdict.OUT_OF_SUPPORT: "Look at these images. Widen the prior or the grammar so that the model can make them, "
    "or remove them from the target folder.",
    Verdict.DOMAIN_SHIFT: "Check that the target folder belongs to this model. If it does, its renders look unlike "
    "the images: change its sprites and their scale",
}
PHOTO = (
    "Add scene.photo(...), with light, colour, blur and noise, to the model, or use sprites and textures that look "
    "more like the images."
)
LONGER = {
    LIKELIHOOD: ("parameters.steps", "parameters.rounds"),
    TILTING: ("parameters.rounds", "parameters.scenes"),
    META_SIM: ("parameters.steps",),
}
NO_SITES = {
    TILTING: "Give the model sites of the whole scene, such as light, whose values show in the images.",
    META_SIM: "Give the model continuous sites.",
}
DOUBTFUL_DOMAIN_SHARE = 0.2  # of the real images: said beside another verdict
FAR_SITE_FLOORS = 2.0  # distance of a site's readings from the target's, from which on it is named
UNCERTAIN_RATIO = 0.7  # below which more images might show a fit to be better


def structure_reason(found: StructureVerdict) -> str:
    """The sentence with the figures that decided."""
    x, verdict, differ = found.statistics, found.verdict, found.statistics.difference
    number = f"{differ.sample_sizes[0]} generated and {differ.sample_sizes[1]} real images"
    feature = "all features together"
    if differ.feature is not None:
        feature = f"the feature {x.feature_names[differ.feature]!r}"
    difference = f"{number} differ significantly, most in {feature} (total variation {differ.total_variation:.2f})"
    shifted = f"{percent(x.domain_shift_share)} of the real images"
    doubt = x.by_patches and x.domain_shift_share > DOUBTFUL_DOMAIN_SHARE
    doubt = f" {shifted} show something that no scene shows." if doubt else ""
    if verdict is Verdict.DOMAIN_SHIFT:
        if x.by_patches:
            return f"{shifted} show something that no scene shows."
        return f"{shifted} have features that are farther from every scene than two random scenes are from each other."
    if verdict is Verdict.OUT_OF_SUPPORT:
        rest = "; without them, generated and real features are less than half as far apart"
        return f"{_out_of_support(x.real_out_of_support)}{rest if found.outliers_explain else ''}."
    if verdict is Verdict.NOT_FITTED:
        return f"{difference}, while generated and prior scenes do not.{doubt}"
    if verdict is Verdict.MODE_COLLAPSE:
        lost = x.modes.collapsed
        real, generated = (percent(float(shares[lost].sum())) for shares in (x.modes.real, x.modes.generated))
        return (
            f"{int(lost.sum())} of {len(lost)} clusters hold {real} of the real images and {generated} of the "
            "generated ones, significantly less than a quarter."
        )
    if verdict is Verdict.UNDERFIT:
        return f"{difference}.{doubt}"
    detectable = "the features hardly vary"
    if differ.detectable is not None:
        detectable = f"a total variation above {differ.detectable:.2f} in any one feature would have been detected"
    return (
        f"{number} do not differ significantly; {detectable}. {percent(x.real_uncovered.share)} of the real images are "
        f"like no generated scene (noise floor: up to {percent(x.real_uncovered.floor)})."
    )


def structure_remedy(run: RunFolder, verdict: Verdict) -> str:
    """What to do about structure."""
    if verdict is Verdict.NOT_FITTED:
        return f"The guide has hardly moved away from the prior. {longer(run, ('structure.batches',))}"
    if verdict is Verdict.UNDERFIT:
        fit_longer = longer(run, ("structure.batches",))
        return f"{fit_longer} If the network counts a class wrongly, that does not help: {label_images(run)}."
    if verdict is Verdict.DOMAIN_SHIFT:
        features = "" if run.features.pretrained else ", or use pretrained features"
        return f"{STRUCTURE_REMEDY[verdict]}{features}."
    return STRUCTURE_REMEDY[verdict]


def residual_reason(figures: ResidualRatio) -> str:
    """The sentence with the figures that a grade of layout or looks rests on."""
    if figures.ratio is None:
        return "Its distance from the target is above the noise floor, and the prior's is not."
    low, ratio, high = (
        f"{100 * max(0.0, share):.0f} %" if np.isfinite(share) else "any share"
        for share in (figures.low, figures.ratio, figures.high)
    )
    nearest = STRUCTURE if figures.nearest == STRUCTURE else "the prior"
    share = f"{ratio} ({low} to {high}) of the squared distance of {nearest} from the target is left"
    return f"{share}{', which is within the noise floor' if figures.close else ''}."


def component_remedy(run: RunFolder, part: str, grade: Grade, figures: ResidualRatio, more_data: str) -> str:
    """What to do about ``layout`` or ``looks``.

    Args:
        more_data: what would make the comparison surer.
    """
    if grade is Grade.GOOD:
        return "Use it."
    sentences = [_learn_parameters(run), _unread_sites(run.parameters), _far_sites(run.parameters)]
    sentences += [PHOTO] if part == "looks" else []
    if figures.ratio is not None and figures.ratio < UNCERTAIN_RATIO and figures.high > BETTER_RATIO:
        sentences.append(more_data)
    return " ".join(filter(None, sentences))


def doubtful_sites_reason(names: tuple[str, ...]) -> tuple[str, str]:
    """Why the whole is not judged for sites that keep the prior, and what to do."""
    reason = f"Every part is good, but {', '.join(names)} kept the prior, which may not be the target's."
    return reason, f"Set these priors by hand, and mark those that are right with infer={{{LEARN!r}: False}}."


def label_images(run: RunFolder) -> str:
    """What to do about classes that are read wrongly in the target's images."""
    if "labels" in run.record:
        return "label more images than this fit had (probscene label), and fit again with all of them"
    return "label ten images (probscene label), and fit again with --labels"


def longer(run: RunFolder, names: tuple[str, ...]) -> str:
    """To take twice as much of some settings, by their paths."""
    settings = run.config.flat()
    values = [settings[name] for name in names]
    options = " ".join(f"--set {name}={max(1, 2 * value)}" for name, value in zip(names, values, strict=True))
    return f"Fit for longer, such as twice as long: {options}."


def percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _out_of_support(found: UncoveredShare) -> str:
    return (
        f"{percent(found.share)} of the real images are like no generated and no prior scene (noise floor: up to "
        f"{percent(found.floor)})"
    )


def _learn_parameters(run: RunFolder) -> str:
    """To learn parameters, or to learn them for longer."""
    record = run.parameters
    method = record.get("method", LIKELIHOOD)
    if not record:
        if run.config.parameters is None:
            return f"Fit again with --learn {BOTH}."
        return f"These features cannot read parameters: fit again with --features count, or --parameters {TILTING}."
    if not any(site["learnt"] for site in record["sites"]):
        if method == LIKELIHOOD:
            return f"The reader cannot read any site. {longer(run, ('parameters.reader_steps',))}"
        return NO_SITES[method]
    if record["kept"] != "learnt":
        return (
            "Learnt parameters came no nearer to held-out images than the prior, so the prior is kept: use the default "
            "preset or more images."
        )
    return longer(run, LONGER[method])


def _unread_sites(record: dict[str, Any]) -> str:
    names = [site["name"] for site in record.get("sites", []) if not site["learnt"]]
    if not names:
        return ""
    what = "Set their priors by hand, or change the program so that their values show in images."
    return f"Not learnt: {', '.join(names)}. {what}"


def _far_sites(record: dict[str, Any]) -> str:
    """Learnt sites whose readings are far from the target's, the farthest first."""
    if record.get("kept") != "learnt":
        return ""
    far = []
    for site in record["sites"]:
        distance = site.get("read", {}).get("distance")
        if site["learnt"] and distance and distance["learnt"] > FAR_SITE_FLOORS * distance["floor"]:
            text = f"{site['name']} ({distance['learnt']:.3f}, noise floor {distance['floor']:.3f})"
            far.append((distance["learnt"], text))
    names = ", ".join(text for _, text in sorted(far, reverse=True))
    return f"Sites whose readings are farthest from the target's: {names}." if names else ""
