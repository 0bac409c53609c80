"""``--set``: what is chosen brings what suits it, and what nothing reads is an error."""

import pytest

from probscene.app.fitting.overrides import override
from probscene.app.fitting.preset import Preset
from probscene.app.fitting.presets import DEFAULT, PRESETS, QUICK
from probscene.errors import ProbsceneError


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
        (["objective=witness", "leave_one_out=true"], "only the objectives kde and js estimate densities"),
        (
            ["objective=mmd", "baseline=leave_one_out"],
            "moving_average or none with objective=mmd, actual leave_one_out",
        ),
    ],
)
def test_settings_that_do_nothing_are_errors(settings, because):
    with pytest.raises(ProbsceneError) as caught:
        override(DEFAULT, settings)
    assert because in str(caught.value)


def test_settings_that_are_read_are_none():
    assert override(QUICK, ["guide=grammar-vae", "hidden=7"]).hidden == 7
    assert override(QUICK, ["objective=mmd", "variance=2"]).variance == 2
    assert override(QUICK, ["objective=mmd", "baseline=none"]).baseline == "none"
