"""The paper's presets pretrain on the prior, and let the guide take whatever the grammar has."""

import torch

from probscene import load_model
from probscene.app.api.fit import fit
from probscene.app.evaluation.sources import PRIOR, START, baseline_policies
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.presets import DEFAULT, PAPER_AERIAL, QUICK
from probscene.app.fitting.run import RunFolder
from probscene.derive import derive
from probscene.inference.pretrain import pretrain
from probscene.inference.training import batch_seed
from probscene.sampling import seed_everything


def begun(config, folder):
    model = load_model("aerial2d")
    record = {"config": config.to_record()}
    return RunFolder.create(folder / "run", "aerial2d", record, loaded=model)


def test_the_prior_is_where_it_starts(tmp_path):
    run = begun(PAPER_AERIAL, tmp_path)
    for opened in (run, RunFolder.at(run.path)):
        assert opened.model.pretraining_policy is opened.model.prior and list(baseline_policies(opened.model)) == [
            PRIOR
        ]
        assert opened.new_guide().support is None
    other = begun(DEFAULT, tmp_path / "other")
    assert list(baseline_policies(other.model)) == [PRIOR, START] and other.new_guide().support is not None


def test_its_guide_reaches_lists_that_the_prior_never_has(tmp_path):
    """At most eight cars are on a road of the prior; an untrained guide derives more."""
    model = begun(PAPER_AERIAL, tmp_path).model
    cars = model.grammar.kind("car")
    torch.manual_seed(0)
    guide = RunFolder.at(tmp_path / "run").new_guide()
    with torch.no_grad():
        guide.out.bias[[i for i, r in enumerate(model.grammar.rules) if str(r) == "Cars -> car Cars"]] += 5
        drawn = derive(model.grammar, guide, 50, model.max_steps)
    longest = (drawn.kind == cars).sum(1).max()
    assert longest > 4 * 8  # on four roads at most


def test_without_batches_structures_stay_the_pretrained_ones(discs, target, tmp_path):
    """The paper's table 1, row 2: parameters are learnt in structures of the prior."""
    settings = {"features": "count", **discs.short, **discs.parameters, "structure.batches": 0, "refine.batches": 0}
    settings |= {"pretrain.on_prior": True, "fallback_to_prior": False}
    execution = Execution(1, cache=False, progress=False)
    run = fit(str(discs.file), target.images, QUICK.set(settings), out=tmp_path / "run", execution=execution)
    seed_everything(batch_seed(run.record["seed"], 2))
    expected = run.new_guide()
    pretrain(expected, run.model.prior, discs.short["pretrain.derivations"], discs.short["pretrain.epochs"])
    assert run.is_finished and run.parameters["sites"]
    found = run.guide.state_dict()
    assert all(torch.equal(found[name], value) for name, value in expected.state_dict().items())
