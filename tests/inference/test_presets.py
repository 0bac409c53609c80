import dataclasses
import json

import pytest
import torch

from probscene.app.fitting.preset import Preset
from probscene.app.fitting.presets import PRESETS, QUICK, preset
from probscene.errors import ProbsceneError
from probscene.inference.divergence import MMD, JensenShannon, KDELogRatio
from probscene.inference.guides.lstm import LSTMGuide
from probscene.inference.objective import ScoreFunction


@pytest.mark.parametrize("name", PRESETS)
def test_a_record_in_json_is_read_back(name):
    record = json.loads(json.dumps(dataclasses.asdict(preset(name))))
    assert Preset.of(record) == preset(name)


def test_the_paper_preset_is_the_papers():
    paper = preset("paper")
    assert paper.divergence() == KDELogRatio(variance=None, marginal_variance=None, leave_one_out=False)
    assert (paper.hidden, paper.num_latents, paper.index) == (50, 1, False)
    assert (paper.num_scenes, paper.num_real, paper.learning_rate, paper.cosine) == (500, 500, 1e-4, False)
    assert (paper.baseline, paper.scale, paper.updates) == ("moving_average", 1e-2, 1)
    assert (paper.pretrain_derivations, paper.pretrain_epochs, paper.pretrain_rate) == (5000, 10, 1e-3)
    assert (paper.on_prior, paper.batches, paper.incompletion_weight) == (True, 200, 0.0)


def test_each_of_the_papers_experiments_has_its_preset():
    paper, aerial, driving = map(preset, ("paper", "paper-aerial", "paper-driving"))
    assert dataclasses.replace(aerial, features=paper.features) == paper and aerial.features == "presence=counts"
    assert driving.divergence() == paper.divergence() and driving.make_features().directions == 0
    assert (driving.num_scenes, driving.num_real, driving.pretrain_derivations) == (300, 300, 6000)
    assert driving.with_features("inception=FILE") == dataclasses.replace(
        driving, features=driving.with_features("inception=FILE").features
    )


def test_a_shared_reward_keeps_a_gradient(small):
    """Under the others' mean as a baseline every advantage would be zero, always; under the moving average from the
    second batch on it is not."""
    mmd = QUICK.with_objective("mmd")
    assert isinstance(mmd.divergence(), MMD)
    loss = ScoreFunction(
        lambda scenes: scenes.derivation.counts(len(small.grammar.kinds)).float(), mmd.divergence(), mmd.baseline
    )
    for _ in range(2):
        loss(small.program, LSTMGuide(small.grammar, 4, hidden=8), 50, real=small.features[:1] + torch.randn(30, 1))
    assert loss.batch.advantage.abs().min() > 0


def test_objectives_and_their_settings():
    for name, expected in {
        "kde": KDELogRatio(1.0, 0.1), "js": JensenShannon(1.0, 0.1), "witness": MMD(1.0, shared=False), "mmd": MMD(1.0)
    }.items():  # fmt: skip
        chosen = QUICK.with_objective(name)
        assert (chosen.objective, chosen.divergence()) == (name, expected)
        assert (chosen.updates == QUICK.updates) == (chosen.baseline == QUICK.baseline) == (name != "mmd")


def test_pretrained_features_bring_their_own_unit():
    """A kernel that was chosen for counts is none for features in units of their bandwidth."""
    street = preset("street")
    assert street.divergence() == JensenShannon(street.variance, 0.1, stabilised=True)
    for features, single in (("efficientnet", None), ("count=efficientnet", 0.1)):
        assert street.with_features(features).divergence() == JensenShannon(1.0, single)
        assert QUICK.with_features(features).divergence() == KDELogRatio(1.0, single)
        assert preset("paper").with_features(features).variance is None
    assert street.with_features("count").divergence() == street.divergence()
    assert street.with_objective("witness").divergence() == MMD(street.variance, shared=False, stabilised=True)
    assert street.with_features("count=efficientnet").prior_kl_weight > street.prior_kl_weight > 0
    assert QUICK.with_features("count=efficientnet").prior_kl_weight == 0


def test_guides_and_their_settings():
    assert QUICK.with_guide("lstm") == QUICK
    for kind in ("pcfg", "grammar-vae"):
        chosen = PRESETS["paper"].with_guide(kind)
        assert chosen.guide_settings()["kind"] == kind
        assert chosen.learning_rate == PRESETS["paper"].learning_rate
    assert chosen.guide_settings() == {"kind": "grammar-vae", "hidden": 100, "num_latents": 32}
    with pytest.raises(ProbsceneError, match="lstm, pcfg, grammar-vae, or FILE.py:NAME, got 'hmm'"):
        QUICK.with_guide("hmm")


def test_unknown_names_are_refused():
    with pytest.raises(ProbsceneError, match="quick"):
        preset("fast")
    with pytest.raises(ProbsceneError, match="kde"):
        QUICK.with_objective("gan")
