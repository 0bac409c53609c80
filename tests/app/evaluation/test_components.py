"""Structure, layout and looks: right where one knows how the target was drawn, and the whole is its worst part."""

import io
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import pyro
import pyro.distributions as dist
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from probscene.app.datasets.generate import generate_scenes
from probscene.app.evaluation import source_features
from probscene.app.evaluation.components import (
    KINDS,
    VerdictComponent,
    VerdictComponents,
    doubtful_sites,
    prior_sites,
    structure_grade,
)
from probscene.app.evaluation.diagnose import diagnose
from probscene.app.evaluation.explain import component_remedy, structure_remedy
from probscene.app.fitting.config import LIKELIHOOD, META_SIM, TILTING, FitConfig
from probscene.app.fitting.presets import preset
from probscene.app.fitting.run import RunFolder
from probscene.app.views import verdict_text
from probscene.dataset import ImageFolder
from probscene.drawing import Sprites
from probscene.grammar import Grammar
from probscene.inference.statistics.residual import Grade, worst_grade
from probscene.inference.statistics.verdict import Verdict
from probscene.model import SceneModel, scene_model
from probscene.structure import StructurePrior, counts, weights

from .colours import ColourFeatures, Colours

GRAMMAR = Grammar("Scene -> Dots\nDots -> Dot Dots | ε\nDot -> red | blue")
PRIOR = StructurePrior(GRAMMAR, Dots=counts(0, 1, 1, 1), Dot=weights(1, 1))
RADIUS = 2.5  # of dots that hardly ever hide one another
TRUTH = StructurePrior(GRAMMAR, Dots=counts(0, 1, 1, 4), Dot=weights(1, 1))


def dots(spread: float = 0.0, of_blue: float | None = None, bright: float = 1.0) -> SceneModel:
    """Dots on a line in the middle, up to ``spread`` pixels off; the prior's are up to 24."""

    @scene_model(GRAMMAR, PRIOR, canvas=(64, 64), max_steps=16, classes=("red", "blue"))
    def dots(scene):
        with scene.nodes("red", "blue"):
            x = pyro.sample("dot.x", dist.Uniform(8.0, 56.0))
            off = pyro.sample("dot.off", dist.Uniform(-1.0, 1.0))
        far = spread if of_blue is None else of_blue
        red, blue = (1.0 * bright, 0.2 * bright, 0.2 * bright), (0.2 * bright, 0.2 * bright, 1.0 * bright)
        return scene.draw(
            Sprites.disc("red", x, 32.0 + spread * off, radius=RADIUS, tint=red),
            Sprites.disc("blue", x, 32.0 + far * off, radius=RADIUS, tint=blue),
        )

    return dots


def quiet(*_):
    pass


@pytest.fixture(scope="module", autouse=True)
def fewer_images():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(source_features, "NUM_IMAGES", 100)
        yield


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A run on dots in a line that has learnt nothing, and its target."""
    folder = tmp_path_factory.mktemp("line")
    generate_scenes(dots(), TRUTH, 240, folder / "target", format="images")
    images = ImageFolder(folder / "target" / "images", (64, 64), 3)
    config = preset("quick").set("parameters=none")
    RunFolder.create(folder / "run", dots(24.0), {"threads": 1, "seed": 0, "config": config.to_record()})
    return SimpleNamespace(path=folder / "run", images=images)


def guided(fitted, *, learnt: SceneModel | None, structure=TRUTH):
    """The run as if it had learnt a structure, and to draw it as ``learnt`` does."""

    class Guided(RunFolder):
        features = ColourFeatures()

        @property
        def guide(self):
            policy = StructurePrior.__new__(StructurePrior)
            policy.__dict__.update(structure.__dict__)
            policy.with_parameters = None if learnt is None else lambda model: replace(model, program=learnt.program)
            return policy

        def network(self):
            return Colours(RADIUS)

    return Guided.at(fitted.path, model=dots(24.0))


def grades(found) -> dict[str, str | None]:
    return {name: part.grade for name, part in found.components.parts.items()}


def test_a_sample_of_the_target_is_good_in_every_part(fitted):
    found = diagnose(guided(fitted, learnt=dots()), fitted.images, quiet, 300)
    assert set(grades(found).values()) == {Grade.GOOD} and found.components.verdict == "good"
    record = json.loads(json.dumps(found.record(), allow_nan=False))
    assert record["verdict"] == record["overall"] == "good" and list(record["parts"]) == list(KINDS)
    for name in ("layout", "looks"):
        distances = record["parts"][name]["distances"]
        assert list(distances) == ["learnt", "structure alone", "prior", "floor"]
        assert distances["learnt"] < 0.3 * distances["structure alone"]
    assert all(each["layout"] == "good" for each in record["classes"].values())
    assert all(each["counts"] in ("good", "cannot be told") for each in record["classes"].values())


@pytest.mark.parametrize("learnt", [None, dots(24.0)])
def test_layout_and_looks_of_the_prior_are_not_good_however_good_the_structure(fitted, learnt):
    found = diagnose(guided(fitted, learnt=learnt), fitted.images, quiet, 300)
    found_grades = grades(found)
    assert found_grades.pop("looks") in (Grade.NO_BETTER, None)  # dots are small, and images few
    assert found_grades.pop("structure") in (Grade.GOOD, Grade.BETTER)  # dots that lie in a line are counted otherwise
    assert found_grades == {"layout": Grade.NO_BETTER}
    record = found.record()
    assert record["overall"] == "no better than the prior" and record["verdict"] != "good"
    assert "--learn structure,parameters" in record["parts"]["layout"]["remedy"]
    assert ("structure alone" in record["parts"]["layout"]["distances"]) is (learnt is not None)


def test_halfway_is_better_than_the_prior(fitted):
    found = diagnose(guided(fitted, learnt=dots(11.0)), fitted.images, quiet, 300)
    assert grades(found)["layout"] is Grade.BETTER and found.components.overall is not Grade.GOOD


def test_a_class_whose_layout_is_the_priors_is_named(fitted):
    found = diagnose(guided(fitted, learnt=dots(0.0, 24.0)), fitted.images, quiet, 300)
    layout = {name: each["layout"] for name, each in found.components.classes.items()}
    assert layout == {"red": Grade.GOOD, "blue": Grade.NO_BETTER} and grades(found)["layout"] is not Grade.GOOD
    assert "Layout by class: good for red; no better than the prior for blue." in printed(found)


def test_what_looks_unlike_the_target_is_no_better_than_the_prior(fitted):
    found = diagnose(guided(fitted, learnt=dots(0.0, bright=0.3)), fitted.images, quiet, 300)
    assert grades(found)["looks"] is not Grade.GOOD and "scene.photo(...)" in found.components.parts["looks"].remedy


def test_features_that_do_not_say_where_objects_are(fitted, monkeypatch):
    monkeypatch.delattr(Colours, "classes")
    found = diagnose(guided(fitted, learnt=dots()), fitted.images, quiet, 300)
    assert grades(found) == {"structure": Grade.GOOD, "layout": None, "looks": Grade.GOOD}
    assert "do not say where objects are" in printed(found) and found.components.verdict == "not judged"
    assert found.record()["overall"] == "not judged"


def test_sites_that_could_not_be_read_are_named(fitted):
    run = guided(fitted, learnt=dots(11.0))
    run.config = run.config.set("parameters=likelihood")
    read = {"distance": {"prior": 0.25, "learnt": 0.12, "floor": 0.02}}
    site = {"kinds": ["red"], "learnt": True, "skill": 0.9, "because": "", "read": read}
    unread = {"kinds": ["red"], "learnt": False, "skill": 0.1, "because": "it cannot be read in renders"}
    record = {"kept": "learnt", "sites": [site | {"name": "dot.off"}, unread | {"name": "dot.x"}]}
    (run.path / "parameters.json").write_text(json.dumps(record))
    try:
        found = diagnose(run, fitted.images, quiet, 300)
    finally:
        (run.path / "parameters.json").unlink()
    assert "Sites that keep the prior: dot.x, as it cannot be read in renders." in printed(found)
    said = found.components.parts["layout"].remedy
    assert "dot.off (0.120, noise floor 0.020)" in said and "Not learnt: dot.x" in said


@pytest.mark.parametrize("method", [LIKELIHOOD, TILTING, META_SIM])
@pytest.mark.parametrize("learnt", [True, False])
def test_the_remedy_names_settings_that_the_fit_reads_and_their_values(method, learnt):
    """Whatever it tells to be set is a setting of the way that was taken, and to be twice what it was."""
    site = {"name": "light", "kinds": [], "learnt": learnt, "skill": None, "because": ""}
    chosen = preset("quick").set(f"parameters={method}")
    run = SimpleNamespace(parameters={"method": method, "kept": "learnt", "sites": [site]}, config=chosen)
    figures = SimpleNamespace(ratio=None, high=None)
    said = component_remedy(run, "looks", Grade.NO_BETTER, figures, "More photographs would decide it.")
    named = re.findall(r"--set ([\w.]+)=(\d+)", said)
    assert said.count("--set") == len(named) and learnt <= bool(named)
    assert all(int(value) == 2 * chosen.flat()[path] for path, value in named)


@pytest.mark.parametrize("verdict", Verdict)
@pytest.mark.parametrize("labelled", [True, False])
def test_structure_that_is_read_wrongly_needs_labels_and_what_is_to_be_set_has_a_value(verdict, labelled):
    features = SimpleNamespace(pretrained=True)
    run = SimpleNamespace(config=preset("quick"), record={"labels": {}} if labelled else {}, features=features)
    said = structure_remedy(run, verdict)
    assert "train the" not in said and ("--set structure.batches=120" in said) is (
        verdict in (Verdict.NOT_FITTED, Verdict.UNDERFIT)
    )
    assert "pretrained" not in said  # which it has
    features.pretrained = False
    assert (structure_remedy(run, verdict) == said) is (verdict is not Verdict.DOMAIN_SHIFT)
    if verdict is Verdict.UNDERFIT:
        assert ("label more images than this fit had" if labelled else "label ten images") in said


def printed(found) -> str:
    out = io.StringIO()
    verdict_text.show(found, Console(width=400, file=out))
    return out.getvalue()


def components_of(*found) -> VerdictComponents:
    parts = zip(KINDS, found, strict=True)

    def component(kind, word):
        verdict = "underfit" if word and kind == "structure" and word != "good" else str(word)
        return VerdictComponent(word, f"{kind}.", verdict=verdict)

    return VerdictComponents({kind: component(kind, word) for kind, word in parts}, {}, {})


@given(st.sampled_from(Grade), st.sampled_from([*Grade, None]), st.sampled_from([*Grade, None]), st.booleans())
def test_the_whole_is_never_better_than_its_worst_part(structure, layout, looks, doubt):
    found = structure, layout, looks
    whole = replace(components_of(*found), doubtful=("dot.x",) if doubt else ())
    good = not doubt and set(found) == {Grade.GOOD}
    assert good is (whole.verdict == "good") is (whole.overall is Grade.GOOD) is (whole.head.grade is Grade.GOOD)
    if not doubt or set(found) != {Grade.GOOD}:
        assert whole.overall is worst_grade(found)
    elif doubt:
        assert whole.verdict == "not judged" and "dot.x kept the prior" in whole.head.reason
    if structure is Grade.GOOD:
        assert (whole.verdict == "not judged") is (whole.overall is None)
    assert json.loads(json.dumps(whole.record()))["sites_in_doubt"] == list(whole.doubtful)


def site(learnt, because="", skill=0.9, prior=None):
    read = {} if prior is None else {"read": {"distance": {"prior": prior, "learnt": 0.01, "floor": 0.02}}}
    return {"name": "dot.x", "kinds": ["red"], "learnt": learnt, "skill": skill, "because": because, **read}


@pytest.mark.parametrize(
    ("of", "kept", "doubtful"),
    [
        (site(True, prior=0.3), "learnt", False),
        (site(True, prior=0.3), "prior", True),  # what was learnt was put aside
        (site(False, "it cannot be read in renders", 0.1), "learnt", True),
        (site(False, "the program says so", None), "learnt", False),
        (site(False, "it is discrete", None), "learnt", True),
        (site(False, "scenes come no nearer", prior=0.03), "learnt", False),  # the target has the prior's
        (site(False, "scenes come no nearer", prior=0.3), "learnt", True),
        (site(False, "scenes come no nearer", 0.3, prior=0.03), "learnt", True),  # read with too little skill to say so
        (site(False, "the similarity of images does not depend on it", None), "learnt", True),
    ],
)
def test_a_site_is_in_doubt_where_it_keeps_a_prior_that_may_not_be_the_targets(of, kept, doubtful):
    run = SimpleNamespace(parameters={"kept": kept, "sites": [of]})
    assert bool(doubtful_sites(run)) is doubtful
    assert bool(prior_sites(run)) is (kept == "prior" or not of["learnt"])


@pytest.mark.parametrize("config", [FitConfig(parameters=None), FitConfig()], ids=["structure", "both"])
def test_sites_that_were_to_be_learnt_by_features_that_read_none_are_in_doubt(config):
    run = SimpleNamespace(parameters={}, config=config, features=SimpleNamespace(name="presence"), model=dots(24.0))
    assert set(doubtful_sites(run)) == (set() if config.parameters is None else {"dot.x", "dot.off"})


@given(st.sampled_from([*Grade, None]), st.sampled_from(Verdict))
def test_structure_is_good_only_by_its_verdict(word, verdict):
    assert (structure_grade(word, verdict) is Grade.GOOD) is (verdict is Verdict.GOOD)
    if verdict in (Verdict.NOT_FITTED, Verdict.DOMAIN_SHIFT):
        assert structure_grade(word, verdict) is Grade.NO_BETTER


def test_each_image_is_the_one_that_generate_writes(fitted, tmp_path):
    run, seen = guided(fitted, learnt=None), []

    class Kept:
        def places(self, images):
            seen.append(images)
            return torch.zeros(len(images), 1), torch.zeros(len(images), 2, 1)

    found = source_features.embed_sources(run, fitted.images, run.network(), Kept(), lambda _: None, 20, 3)
    assert set(found) == {source_features.TARGET, source_features.LEARNT, source_features.PRIOR}
    generate_scenes(run.model, TRUTH, 20, tmp_path / "again", 3, "images")
    again = ImageFolder(tmp_path / "again" / "images", (64, 64), 3)
    assert torch.equal(seen[1], torch.stack([again.load(i) for i in range(20)]))
