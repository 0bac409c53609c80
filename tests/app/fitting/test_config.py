"""``FitConfig``: what is chosen brings what suits it, what nothing reads cannot be set, and records are read back."""

import json
from dataclasses import fields, is_dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.app.fitting.config import (
    DIVERGENCES,
    METHODS,
    FitConfig,
    GrammarVAEConfig,
    LSTMConfig,
    configuration,
    from_flat_preset,
)
from probscene.app.fitting.presets import DEFAULT, PRESETS, QUICK, preset
from probscene.errors import ProbsceneError
from probscene.inference.divergence import MMD, JensenShannon, KDELogRatio
from probscene.inference.guides.lstm import GUIDES

FEATURES = ("count", "count=efficientnet", "presence", "presence=counts", "efficientnet", "inception=weights.pth")
NAMES = {"guide": GUIDES, "divergence": DIVERGENCES, "features": FEATURES, "parameters": (*METHODS, "none")}
CHOSEN = st.fixed_dictionaries({}, optional={name: st.sampled_from(words) for name, words in NAMES.items()})


@given(st.sampled_from(sorted(PRESETS)), CHOSEN)
def test_a_record_in_json_is_read_back(name, chosen):
    config = configuration(preset(name), **chosen)
    for each in (config, config.for_renders(), config.for_photographs()):
        assert FitConfig.from_record(json.loads(json.dumps(each.to_record()))) == each


@pytest.mark.parametrize("config", PRESETS.values(), ids=PRESETS)
@pytest.mark.parametrize(("name", "words"), NAMES.items())
def test_a_setting_is_the_option_of_the_same_name(config, name, words):
    for word in words:
        assert config.set(f"{name}={word}") == configuration(config, **{name: word})


def test_what_is_set_beside_a_choice_wins_whatever_comes_first():
    for settings in (["pretrain.learning_rate=0.5", "guide=pcfg"], ["guide=pcfg", "pretrain.learning_rate=0.5"]):
        made = QUICK.set(*settings)
        assert (made.guide.kind, made.pretrain.learning_rate) == ("pcfg", 0.5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["guide=pcfg", "guide.hidden=20"], r"a setting of guide \(PCFGConfig\) among none, got 'guide.hidden'"),
        (["guide.num_latents=2", "guide=pcfg"], "PCFGConfig"),
        (["guide=grammar-vae", "guide.index=false"], "among hidden, num_latents, got 'guide.index'"),
        (["divergence=mmd", "divergence.marginal_variance=1"], "MMD"),
        (
            ["features=efficientnet", "features.schedule.steps=9"],
            "ProjectedFeatures.* network, pairs, directions",
        ),
        (["features=presence", "features.blocks=1,2"], "PresenceFeatures"),
        (["features=count", "features.epochs=2"], "CountFeatures"),
        (["features=count", "features.directions=2"], "CountFeatures"),
        (["features=efficientnet", "features.scenes=9"], "ProjectedFeatures"),
        (["features.directions=2"], "CountFeatures"),
        (["parameters=none", "parameters.rounds=1"], "no setting of parameters = none"),
        (["parameters=none", "refine.batches=5"], "no setting of refine = none"),
        (["parameters=meta-sim", "parameters.scene_renders=1"], "MetaSimSchedule"),
        (["parameters.hidden=8"], "ParameterSchedule"),
        (["divergence=witness", "divergence.leave_one_out=true"], "MMD"),
        (["divergence=mmd", "structure.baseline=leave_one_out"], "moving_average or none with a shared MMD"),
        (["parameters=none", "structure.batches=0"], "structure.batches of at least 1 where structure alone is learnt"),
        (["structure=1"], "a path such as structure.batches, got 'structure' alone"),
        (["structure.batches.x=1"], "no setting of structure.batches"),
    ],
)
def test_settings_that_nothing_reads_are_errors(settings, message):
    with pytest.raises(ProbsceneError, match=f"^expected .*{message}"):
        DEFAULT.set(*settings)


def test_values_are_checked_where_they_are_made():
    from dataclasses import replace

    for made in (lambda: replace(QUICK.structure, num_scenes=1), lambda: replace(QUICK.structure, scale=0.0)):
        with pytest.raises(ProbsceneError, match="expected structure"):
            FitConfig(structure=made())


def leaves(value, path=()):
    for one in fields(value):
        inner, at = getattr(value, one.name), (*path, one.name)
        yield from leaves(inner, at) if is_dataclass(inner) else [at]


def test_what_features_for_photographs_read_may_be_set_before_they_are_chosen():
    made = QUICK.set("features.epochs=2", "features.schedule.steps=9", "structure.batches=7")
    renders, photographs = made.for_renders(), made.for_photographs()
    assert (renders.features.schedule.steps, photographs.features.epochs) == (9, 2)
    assert renders.structure.batches == photographs.structure.batches == 7
    assert photographs.structure.num_scenes != renders.structure.num_scenes  # which suits the features
    assert made.set("parameters=likelihood").for_photographs().parameter_method == "likelihood"
    assert photographs.parameter_method == "tilting"


def test_features_have_their_unit_for_batches_of_the_fit():
    made = QUICK.with_features("efficientnet").set("structure.num_scenes=33")
    assert made.features.scenes == 33
    assert ("features", "scenes") in set(leaves(made)) and "features.scenes" not in made.flat()


def test_the_paper_preset_is_the_papers():
    paper = preset("paper")
    assert paper.divergence == KDELogRatio(variance=None, marginal_variance=None, leave_one_out=False)
    assert paper.guide == LSTMConfig(hidden=50, num_latents=1, index=False)
    training = paper.structure
    assert (training.num_scenes, training.num_real, training.learning_rate, training.cosine) == (500, 500, 1e-4, False)
    assert (training.baseline, training.scale, training.updates) == ("moving_average", 1e-2, 1)
    assert (training.batches, training.incompletion_weight) == (200, 0.0)
    pretraining = paper.pretrain
    assert (pretraining.derivations, pretraining.epochs, pretraining.learning_rate) == (5000, 10, 1e-3)
    assert pretraining.on_prior and paper.parameters is None


def test_each_of_the_papers_experiments_has_its_preset():
    paper, aerial, driving = map(preset, ("paper", "paper-aerial", "paper-driving"))
    assert aerial == paper.with_features("presence=counts") and aerial.features.name == "presence=counts"
    assert driving.divergence == paper.divergence and driving.features.directions == 0
    assert (driving.structure.num_scenes, driving.structure.num_real) == (300, 300)
    assert driving.pretrain.derivations == 6000
    other = driving.with_features("inception=FILE")
    assert other.features.network == "inception=FILE" and other.structure == driving.structure


def test_divergences_and_their_settings():
    for name, expected in {
        "kde": KDELogRatio(1.0, 0.1), "js": JensenShannon(1.0, 0.1), "witness": MMD(1.0, shared=False), "mmd": MMD(1.0)
    }.items():  # fmt: skip
        chosen = QUICK.with_divergence(name)
        assert (chosen.divergence_name, chosen.divergence) == (name, expected)
        assert (chosen.structure == QUICK.structure) == (name != "mmd")


def test_pretrained_features_bring_their_own_unit():
    """A kernel that was chosen for counts is none for features in units of their bandwidth."""
    street = preset("street")
    assert street.divergence == JensenShannon(1.0, 0.1, anscombe=True)
    for features, single in (("efficientnet", None), ("count=efficientnet", 0.1)):
        assert street.with_features(features).divergence == JensenShannon(1.0, single)
        assert QUICK.with_features(features).divergence == KDELogRatio(1.0, single)
        assert preset("paper").with_features(features).divergence.variance is None
    assert street.with_features("count").divergence == street.divergence
    assert street.with_divergence("witness").divergence == MMD(1.0, shared=False, anscombe=True)
    assert street.for_photographs().structure.prior_kl_weight > street.structure.prior_kl_weight > 0
    assert QUICK.for_photographs().structure.prior_kl_weight == 0


def test_guides_and_their_settings():
    assert QUICK.with_guide("lstm") == QUICK
    for kind in ("pcfg", "grammar-vae"):
        chosen = PRESETS["paper"].with_guide(kind)
        assert chosen.guide_record()["kind"] == kind and chosen.structure == PRESETS["paper"].structure
    assert chosen.guide == GrammarVAEConfig(hidden=100, num_latents=32)


@pytest.mark.parametrize(
    ("choice", "word", "message"),
    [
        ("guide", "hmm", "lstm, pcfg, grammar-vae, or FILE.py:NAME, got 'hmm'"),
        ("divergence", "gan", "kde, js, witness, mmd, or FILE.py:NAME, got 'gan'"),
        ("features", "vgg", "among count, .*got 'vgg'"),
        ("parameters", "em", "likelihood, tilting, meta-sim or none, got 'em'"),
    ],
)
def test_unknown_names_are_refused(choice, word, message):
    with pytest.raises(ProbsceneError, match=message):
        configuration(QUICK, **{choice: word})
    with pytest.raises(ProbsceneError, match="quick"):
        preset("fast")


def test_a_flat_preset_of_an_older_run_is_read():
    """As format 3 had it, and version 0.1 with other names of three settings."""
    count = {"steps": 48, "images": 4}
    guide = {"kind": "lstm", "hidden": 50, "num_latents": 1, "index": True}
    record = {"features": "count", "count": count, "width": [4, 8, 8], "blocks": [1, 1], "objective": "kde"}
    record |= {"variance": 2.0, "batches": 7, "candidates": 3, "leak": 0.5, "anchor": 0.25, "learn": "structure"}
    found = from_flat_preset(record, guide)
    assert (found.features.schedule.steps, found.features.width) == (48, (4, 8, 8))
    assert found.divergence == KDELogRatio(2.0) and found.guide == LSTMConfig() and found.parameters is None
    training = found.structure
    assert (training.batches, training.draws_per_structure) == (7, 3)
    assert (training.incompletion_weight, training.prior_kl_weight) == (0.5, 0.25)
    both = from_flat_preset(record | {"learn": "structure,parameters", "parameters": {"rounds": 9}}, guide)
    assert both.parameters.rounds == 9 and both.refine.batches == 40
