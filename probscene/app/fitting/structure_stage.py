"""The stages of a fit that learn structure: before its parameters, and once more after them.

Before, scenes have the prior's layout and looks, in which objects lie over one another that do not in the target, so
that their counts are read otherwise. With learnt parameters both are read alike, and a second, shorter pass takes the
difference out. Axis letters: L images, D features.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.device import CPU
from probscene.inference.count_penalty import PriorCountPenalty
from probscene.inference.divergence import Divergence
from probscene.inference.features.base import FeatureNet, embed_all
from probscene.inference.features.counting.net import CountNet
from probscene.inference.guides.base import Guide
from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
from probscene.inference.parameters.reader_counts import ReaderCounts
from probscene.inference.pretrain import pretrain
from probscene.inference.render_cache import RenderCache
from probscene.inference.statistics.energy import bootstrap_test
from probscene.inference.structure_training import StructureSchedule, StructureTraining
from probscene.inference.training import Training, batch_seed
from probscene.model import SceneModel
from probscene.sampling import sample, seed_everything

from ..progress import Progress
from ..workers.actor_pool import ActorPool
from ..workers.cluster import Cluster
from .config import ScoreFunctionTraining
from .learnt_parameters import NAME, prefixed, with_parameters
from .outcome import feature_mask
from .parameter_stage import READER
from .plugins import ValidatedDivergence, inner
from .rendered_features import RENDERED_AT_ONCE, Chunk, Observe, RenderedFeatures
from .run import RunFolder
from .store import Checkpointer

FIRST, REFINEMENT = "guide", "refinement"  # of the checkpoints
BEFORE = "guide-first"  # of the guide that parameters are learnt with
SLOWER = 0.2  # of the first pass's rate


def learn_structure(
    run: RunFolder,
    observer: RenderedFeatures,
    net: FeatureNet,
    real: Tensor,
    progress: Progress,
    cluster: Cluster | None = None,
    device: torch.device = CPU,
) -> Guide:
    """A guide of the structures of a model with the prior's parameters.

    Args:
        real: ``(L, D)``.
        cluster: of which all nodes render and read scenes; else this process does.
        device: where features are compared.

    Raises:
        ProbsceneError: a cost or a parameter is no longer finite.
    """
    training, seed = run.config.structure, run.record["seed"]
    seed_everything(batch_seed(seed, 2))
    guide, known = run.new_guide(), run.read_tensors(BEFORE)
    if known is not None:
        guide.load_state_dict(known)
        return guide
    pool, crew = _pool(run, run.model), _crew(run, cluster, training.draws_per_structure)
    observe = observer.resample_and_embed(net, training.draws_per_structure, crew)
    objective = _objective(run, run.model, observe, _divergence(run, net, device), guide, pool)
    schedule = _schedule(training, training.batches, training.learning_rate)
    trainer = StructureTraining(run.model, guide, objective, real, schedule, batch_seed(seed, 3), pool)
    keep = Checkpointer(run, FIRST, trainer)
    if trainer.done == 0:
        pretraining = run.config.pretrain
        epochs = pretraining.epochs
        pretrain(
            guide,
            run.model.pretraining_policy,
            pretraining.derivations,
            epochs,
            learning_rate=pretraining.learning_rate,
            progress=lambda epoch, loss: progress("pretraining", epoch + 1, epochs, f"{loss:.2f} nats a scene"),
        )
    _run(trainer, keep, "structure", progress, crew)
    if run.config.parameters is not None:
        run.write_tensors(BEFORE, guide.state_dict())
    return guide


def refine_structure(
    run: RunFolder,
    net: FeatureNet,
    real: Tensor,
    guide: Guide,
    images: Callable[[], Images],
    progress: Progress,
    cluster: Cluster | None = None,
    device: torch.device = CPU,
) -> None:
    """Go on with a guide whose scenes have learnt parameters; as it is where they have none, and as it was where its
    scenes end farther from the target. Both are seen by what the reader of parameters finds, where that tells more of
    the scenes' structures than the network.

    Args:
        real: ``(L, D)``.
        images: opens the target.
        cluster, device: see ``learn_structure``.

    Raises:
        ProbsceneError: a cost or a parameter is no longer finite.
    """
    config, seed = run.config, run.record["seed"]
    if guide.with_parameters is None or config.refine is None or not config.refine.batches:
        return
    seed_everything(batch_seed(seed, 8))
    model = guide.with_parameters(run.model)
    observer, before = (
        RenderedFeatures(model, run.record["threads"]),
        {k: v.clone() for k, v in guide.state_dict().items()},
    )
    finder = _finder(run, net, observer, guide)
    if finder is not None:
        net, real = finder, embed_all(finder, images().batches(RENDERED_AT_ONCE))
    pool, crew = _pool(run, model), _crew(run, cluster, 1, again=True, finder=finder is not None)
    observe = observer.resample_and_embed(net, 1, crew)
    objective = _objective(run, model, observe, _divergence(run, net, device), guide, pool)
    schedule = _schedule(config.structure, config.refine.batches, SLOWER * config.structure.learning_rate)
    trainer = StructureTraining(model, guide, objective, real, schedule, batch_seed(seed, 7), pool)
    seen = _features_of_samples(run, observer, net, guide)
    _run(trainer, Checkpointer(run, REFINEMENT, trainer), REFINEMENT, progress, crew)
    which = feature_mask(net)
    which = slice(None) if which is None else which
    now, then, target = (
        part[:, which].double().numpy() for part in (_features_of_samples(run, observer, net, guide), seen, real)
    )
    if bootstrap_test(now, then, target).significant:
        guide.load_state_dict(before)


def _features_of_samples(run: RunFolder, observer: RenderedFeatures, net: FeatureNet, guide: Guide) -> Tensor:
    """Features of scenes of the guide, as many as a batch has."""
    seed_everything(batch_seed(run.record["seed"], 9))
    with torch.no_grad():
        return observer.observe(net)(sample(run.model, guide, run.config.structure.num_scenes))


def _finder(run: RunFolder, net: FeatureNet, observer: RenderedFeatures, guide: Guide) -> ReaderCounts | None:
    """Counts of what the reader finds, where they are nearer to those of a guide's scenes than the network's are."""
    finder = _reader_counts(run, net)
    if finder is None:
        return None
    seed_everything(batch_seed(run.record["seed"], 10))
    kinds = [run.model.grammar.kind(name) for name in run.model.classes]
    with torch.no_grad():
        scenes = sample(run.model, guide, run.config.structure.num_scenes)
        drawn = scenes.derivation.counts(len(run.model.grammar.kinds))[:, kinds]
        of_finder, of_network = (_wrong(observer.observe(one)(scenes)[:, : len(kinds)], drawn) for one in (finder, net))
    return finder if of_finder < of_network else None


def _wrong(seen: Tensor, drawn: Tensor) -> float:
    """By how much counts are wrong, in the mean."""
    return float((seen - drawn).abs().mean())


def _reader_counts(run: RunFolder, net: FeatureNet) -> ReaderCounts | None:
    """None where there is no reader, or classes are counted group by group."""
    state, counts = run.read_tensors(READER), inner(net)
    return ReaderCounts(counts, state) if state and isinstance(counts, CountNet) and counts.groups is None else None


def _pool(run: RunFolder, model: SceneModel) -> RenderCache | None:
    return RenderCache(model, size) if (size := run.config.structure.render_cache) else None


def _crew(
    run: RunFolder, cluster: Cluster | None, draws_per_structure: int, again: bool = False, finder: bool = False
) -> ActorPool | None:
    task = run.path.resolve(), draws_per_structure, again, finder
    return None if cluster is None else cluster.actor_pool(_actor, task, run.record["threads"])


def _actor(path: Path, draws_per_structure: int, again: bool, finder: bool) -> Callable[[Chunk], tuple[int, Tensor]]:
    """What a node of a cluster does with a part of a batch."""
    run = RunFolder.at(path)
    model, net = run.model, run.network()
    assert net is not None
    if again:
        tensors = prefixed(run.read_tensors(NAME) or {})
        policy = with_parameters(model, run.config, run.parameters, run.new_guide(), tensors)
        model = model if policy.with_parameters is None else policy.with_parameters(model)
    net = (_reader_counts(run, net) if finder else None) or net
    observer = RenderedFeatures(model, run.record["threads"])
    return lambda part: observer.part(part, net, draws_per_structure)


def _divergence(run: RunFolder, net: FeatureNet, device: torch.device) -> Divergence:
    """The run's, of features on the CPU; computed on the device where it is ours."""
    divergence = run.divergence(inner(net))
    if device == CPU or isinstance(divergence, ValidatedDivergence):
        return divergence
    return lambda generated, real: divergence(generated.to(device), real.to(device)).cpu()


def _objective(
    run: RunFolder,
    model: SceneModel,
    observe: Observe,
    divergence: Divergence,
    guide: Guide,
    pool: RenderCache | None,
) -> ScoreFunction:
    kinds = {*run.unread, *(model.stuff if run.readings else ())}
    held = PriorCountPenalty(model, kinds, run.config.structure.num_scenes)
    observe = held.append_counts(observe if pool is None else pool.wrap(observe))
    return score_function(run.config.structure, model, observe, held.add_to(divergence), guide)


def score_function(
    training: ScoreFunctionTraining, model: SceneModel, observe: Observe, divergence: Divergence, guide: Guide
) -> ScoreFunction:
    """The loss by which a guide of the model learns, with the configured settings.

    Args:
        observe: features ``(N, D)`` of a batch of scenes.
        divergence: of these from the target's.
    """
    config = ScoreFunctionConfig(
        baseline=training.baseline,
        updates=training.updates,
        scale=training.scale,
        incompletion_weight=training.incompletion_weight,
        prior_kl_weight=training.prior_kl_weight,
    )
    return ScoreFunction(observe, divergence, config, prior=model.pretraining_policy, strata=guide.strata)


def _schedule(training: ScoreFunctionTraining, batches: int, rate: float) -> StructureSchedule:
    return StructureSchedule(batches, training.num_scenes, training.num_real, rate, training.cosine)


def _run(
    trainer: StructureTraining, keep: Checkpointer, stage: str, progress: Progress, crew: ActorPool | None
) -> None:
    def each(trainer: Training, diagnostics: dict[str, float]) -> None:
        keep({"stage": stage, **diagnostics})
        progress(stage, trainer.done, trainer.total, f"cost {diagnostics['cost']:.3f}")

    try:
        trainer.run(each)
    finally:
        if crew is not None:
            crew.close()
    keep.finish()
