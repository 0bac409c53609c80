"""``--set``: what is chosen brings what suits it, and what nothing reads is an error."""

from dataclasses import fields

import pytest

from probscene.app.fitting.overrides import override
from probscene.app.fitting.preset import (
    BOTH,
    FOR_PHOTOGRAPHS,
    FOR_RENDERS,
    LIKELIHOOD,
    META_SIM,
    OBJECTIVES,
    STRUCTURE,
    TILTING,
    Preset,
)
from probscene.app.fitting.presets import DEFAULT, PRESETS, QUICK
from probscene.errors import ProbsceneError
from probscene.inference.guides.lstm import GUIDES


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
@pytest.mark.parametrize(
    ("setting", "word"),
    [
        ("guide", "pcfg"),
        ("guide", "grammar-vae"),
        ("objective", "mmd"),
        ("objective", "js"),
        ("features", "efficientnet"),
    ],
)
def test_a_setting_is_the_option_of_the_same_name(preset, setting, word):
    option = {"guide": Preset.with_guide, "objective": Preset.with_objective, "features": Preset.with_features}[setting]
    assert override(preset, [f"{setting}={word}"]) == option(preset, word)


def test_what_is_set_beside_a_choice_wins_whatever_comes_first():
    for settings in (["pretrain_rate=0.5", "guide=pcfg"], ["guide=pcfg", "pretrain_rate=0.5"]):
        made = override(QUICK, settings)
        assert (made.guide, made.pretrain_rate) == ("pcfg", 0.5)


@pytest.mark.parametrize(
    ("settings", "because"),
    [
        (["guide=pcfg", "hidden=20"], "--set hidden=...: the guide 'pcfg' has no such setting; leave it out"),
        (["num_latents=2", "guide=pcfg"], "the guide 'pcfg' has no such setting"),
        (["guide=grammar-vae", "index=false"], "the guide 'grammar-vae' has no such setting"),
        (["objective=mmd", "marginal_variance=1"], "only the objectives kde and js estimate densities"),
        (["features=efficientnet", "count.steps=9"], "the features 'efficientnet' have no such setting"),
        (["features=presence", "blocks=1,2"], "the features 'presence' have no such setting"),
        (["features=count", "head_epochs=2"], "the features 'count' have no such setting"),
        (["features=count", "directions=2"], "the features 'count' have no such setting"),
        (["learn=structure", "parameters.rounds=1"], "the fit learns structure alone"),
        (["learn=structure", "batches_again=5"], "the fit learns structure alone"),
        (["parameter_method=meta-sim", "parameters.rounds=1"], "parameters are learnt by meta-sim"),
        (["meta_sim.hidden=8"], "parameters are learnt by likelihood"),
        (["objective=witness", "leave_one_out=true"], "only the objectives kde and js estimate densities"),
        (
            ["objective=mmd", "baseline=leave_one_out"],
            "moving_average or none with objective=mmd, got leave_one_out",
        ),
        (["learn=structure", "batches=0"], "batches of at least 1 where structure alone is learnt, got 0"),
    ],
)
def test_settings_that_do_nothing_are_errors(settings, because):
    with pytest.raises(ProbsceneError) as caught:
        override(DEFAULT, settings)
    assert because in str(caught.value)


def test_every_field_is_read_by_some_choice():
    """No setting is one that nothing reads, and none is named that there is not."""
    choices = [
        *(
            [f"features={name}"]
            for name in ("count", "count=efficientnet", "presence", "presence=counts", "efficientnet")
        ),
        *([f"objective={name}", "baseline=none"] for name in OBJECTIVES),
        *([f"guide={name}"] for name in GUIDES),
        [f"learn={STRUCTURE}"],
        *([f"learn={BOTH}", f"parameter_method={name}"] for name in (LIKELIHOOD, TILTING, META_SIM)),
    ]
    unread = [set(override(QUICK, settings).unread()) for settings in choices]
    assert set.intersection(*unread) == set()
    assert set.union(*unread) <= {field.name for field in fields(Preset)}


def test_what_features_for_photographs_read_may_be_set_before_they_are_chosen():
    for settings in (["head_epochs=2"], ["count.steps=9"], ["parameters.rounds=1"]):
        for features in (FOR_RENDERS, FOR_PHOTOGRAPHS):
            instead = FOR_RENDERS if features == FOR_PHOTOGRAPHS else FOR_PHOTOGRAPHS
            override(QUICK.with_features(features), settings, QUICK.with_features(instead))
    with pytest.raises(ProbsceneError, match="the features 'count' have no such setting"):
        override(QUICK, ["directions=2"], QUICK.with_features(FOR_PHOTOGRAPHS))
    with pytest.raises(ProbsceneError, match="the guide 'pcfg' has no such setting"):
        override(QUICK.with_guide("pcfg"), ["hidden=2"], QUICK.with_guide("pcfg").with_features(FOR_PHOTOGRAPHS))


def test_settings_that_are_read_are_none():
    assert override(QUICK, ["guide=grammar-vae", "hidden=7"]).hidden == 7
    assert override(QUICK, ["objective=mmd", "variance=2"]).variance == 2
    assert override(QUICK, ["objective=mmd", "baseline=none"]).baseline == "none"
