"""The stages of a fit that learn structure: before its parameters, and once more after them.

Before, scenes have the prior's layout and looks, in which objects lie over one another that do not in the target, so
that their counts are read otherwise. With learnt parameters both are read alike, and a second, shorter pass takes the
difference out. Axis letters: L images, D features.
"""

import torch
from torch import Tensor

from probscene.inference.features.base import FeatureNet
from probscene.inference.guides.base import Guide
from probscene.inference.holding import Held
from probscene.inference.judging.farther import farther
from probscene.inference.learn import Trainer
from probscene.inference.objective import ScoreFunction
from probscene.inference.pretrain import pretrain
from probscene.inference.reuse import RenderPool
from probscene.inference.training import Training, batch_seed
from probscene.model import SceneModel
from probscene.sampling import sample, seed_everything

from ...progress import Progress
from ..observer import Observer
from ..parts import inner
from ..run import RunFolder
from ..storage import Keeper
from .outcome import compared

FIRST, AGAIN = "guide", "structure-again"  # of the checkpoints
BEFORE = "guide-first"  # of the guide that parameters are learnt with
SLOWER = 0.2  # of the first pass's rate


def learn_structure(run: RunFolder, observer: Observer, net: FeatureNet, real: Tensor, progress: Progress) -> Guide:
    """A guide of the structures of a model with the prior's parameters.

    Args:
        real: ``(L, D)``.

    Raises:
        ProbsceneError: a cost or a parameter is no longer finite.
    """
    preset, seed = run.preset, run.record["seed"]
    seed_everything(batch_seed(seed, 2))
    guide, known = run.new_guide(), run.read_tensors(BEFORE)
    if known is not None:
        guide.load_state_dict(known)
        return guide
    pool = _pool(run, run.model)
    objective = _objective(run, run.model, observer, net, guide, preset.draws_per_structure, pool)
    rate, seeds = preset.learning_rate, batch_seed(seed, 3)
    trainer = _trainer(run, run.model, guide, objective, real, preset.batches, rate, seeds, pool)
    keep = Keeper(run, FIRST, trainer)
    if trainer.done == 0:
        epochs = preset.pretrain_epochs
        pretrain(
            guide,
            run.model.pretraining_policy,
            preset.pretrain_derivations,
            epochs,
            learning_rate=preset.pretrain_rate,
            progress=lambda epoch, loss: progress("pretraining", epoch + 1, epochs, f"{loss:.2f} nats a scene"),
        )
    _run(trainer, keep, "structure", progress)
    if "parameters" in preset.learn:
        run.write_tensors(BEFORE, guide.state_dict())
    return guide


def learn_structure_again(run: RunFolder, net: FeatureNet, real: Tensor, guide: Guide, progress: Progress) -> None:
    """Go on with a guide whose scenes have learnt parameters; as it is where they have none, and as it was where its
    scenes end farther from the target.

    Args:
        real: ``(L, D)``.

    Raises:
        ProbsceneError: a cost or a parameter is no longer finite.
    """
    preset, seed = run.preset, run.record["seed"]
    if guide.suits is None or not preset.batches_again:
        return
    seed_everything(batch_seed(seed, 8))
    model = guide.suits(run.model)
    observer, before = Observer(model, run.record["threads"]), {k: v.clone() for k, v in guide.state_dict().items()}
    pool = _pool(run, model)
    objective = _objective(run, model, observer, net, guide, 1, pool)
    rate, seeds = SLOWER * preset.learning_rate, batch_seed(seed, 7)
    trainer = _trainer(run, model, guide, objective, real, preset.batches_again, rate, seeds, pool)
    seen = _seen(run, observer, net, guide)
    _run(trainer, Keeper(run, AGAIN, trainer), AGAIN, progress)
    which = compared(net)
    which = slice(None) if which is None else which
    now, then, target = (part[:, which].double().numpy() for part in (_seen(run, observer, net, guide), seen, real))
    if farther(now, then, target).sure:
        guide.load_state_dict(before)


def _seen(run: RunFolder, observer: Observer, net: FeatureNet, guide: Guide) -> Tensor:
    """Features of scenes of the guide, as many as a batch has."""
    seed_everything(batch_seed(run.record["seed"], 9))
    with torch.no_grad():
        return observer.observe(net)(sample(run.model, guide, run.preset.num_scenes))


def _pool(run: RunFolder, model: SceneModel) -> RenderPool | None:
    return RenderPool(model, run.preset.reuse) if run.preset.reuse else None


def _objective(
    run: RunFolder,
    model: SceneModel,
    observer: Observer,
    net: FeatureNet,
    guide: Guide,
    draws_per_structure: int,
    pool: RenderPool | None,
) -> ScoreFunction:
    preset, observe = run.preset, observer.observe(net, draws_per_structure)
    held = Held(model, {*run.unread, *(model.stuff if run.readings else ())}, preset.num_scenes)
    return ScoreFunction(
        held.beside(observe if pool is None else pool.around(observe)),
        held.added_to(run.divergence(inner(net))),
        baseline=preset.baseline,
        updates=preset.updates,
        scale=preset.scale,
        strata=guide.strata,
        incompletion_weight=preset.incompletion_weight,
        prior=model.pretraining_policy,
        prior_kl_weight=preset.prior_kl_weight,
    )


def _trainer(
    run: RunFolder,
    model: SceneModel,
    guide: Guide,
    objective: ScoreFunction,
    real: Tensor,
    batches: int,
    rate: float,
    seed: int,
    pool: RenderPool | None,
) -> Trainer:
    preset = run.preset
    scenes, images = preset.num_scenes, preset.num_real
    return Trainer(model, guide, objective, real, batches, scenes, images, rate, preset.cosine, seed, pool)


def _run(trainer: Trainer, keep: Keeper, stage: str, progress: Progress) -> None:
    def each(trainer: Training, diagnostics: dict[str, float]) -> None:
        keep({"stage": stage, **diagnostics})
        progress(stage, trainer.done, trainer.total, f"cost {diagnostics['cost']:.3f}")

    trainer.run(each)
    keep.finish()
