"""The stage of a fit that learns parameters, and what a run keeps of it.

``parameters.json`` says of each site whether it is learnt, and why not. The learnt network is kept with the guide, so
that one digest is of both. Axis letters: L images, C H W.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor

from probscene.dataset import Images
from probscene.device import CPU
from probscene.inference.features.base import FeatureNet
from probscene.inference.guides.base import Guide
from probscene.inference.parameters.backbone import Backbone, RenderBackbone
from probscene.inference.parameters.learning import ParameterLearning
from probscene.inference.parameters.meta_sim.schedule import MetaSimSchedule
from probscene.inference.parameters.reader_counts import counting_state
from probscene.inference.parameters.schedule import ParameterSchedule
from probscene.inference.parameters.tilting.schedule import TiltingSchedule
from probscene.inference.training import Training, batch_seed
from probscene.sampling import seed_everything
from probscene.scenarios import JointGrammar

from ..progress import Progress
from .box_margins import box_margins, margins_said, without_margins
from .config import LIKELIHOOD
from .given_boxes import given_boxes
from .image_level import ImageLevelTraining, labelled_objects, meta_sim_learning, sites_record, tilting_learning
from .learnt_parameters import NAME, prefixed, with_parameters
from .plugins import inner
from .rendered_features import RenderedFeatures
from .run import RunFolder
from .site_selection import select_sites
from .store import Checkpointer

READER = "reader"  # of the file with what finds objects, until structure was learnt again
HELD = 5  # one image of the target in so many is not learnt from, and judges
MAX_HELD_OUT = 500  # of those images, at most


def learn_parameters(
    run: RunFolder,
    observer: RenderedFeatures,
    net: FeatureNet,
    guide: Guide,
    images: Callable[[], Images],
    progress: Progress,
    say: Callable[[str], None],
    device: torch.device = CPU,
) -> None:
    """Learn the parameters of the model's sites; from now on the guide's scenes have them, where they are kept.

    Args:
        net: what structure was learnt by.
        guide: of the structures; its scenes are rendered.
        images: opens the target.
        say: is told which sites were learnt.
        device: of the networks that whole images are compared by.

    Raises:
        ProbsceneError: a loss is no longer finite.
    """
    seed_everything(batch_seed(run.record["seed"], 5))
    backbone, schedule = Backbone.from_feature_net(inner(net)), run.config.parameters
    by_reading = isinstance(schedule, ParameterSchedule)
    joint = isinstance(schedule, MetaSimSchedule) and isinstance(run.model.grammar, JointGrammar)
    if joint or (by_reading and backbone is None):
        why = (
            "meta-sim takes no models of several scenarios"
            if joint
            else f"{run.features.name} features do not read them"
        )
        say(f"Position and appearance keep the prior: {why}.")
        return
    kept = run.read_tensors(NAME)
    if kept is None:
        target = images()
        held = torch.arange(len(target)) % HELD == HELD - 1
        if isinstance(schedule, ParameterSchedule) and backbone is not None:
            learning = ParameterLearning(
                run.model,
                guide,
                backbone,
                observer.labelled,
                cache(lambda: _some(target, ~held, schedule.images)),
                schedule,
                batch_seed(run.record["seed"], 5),
            )
        elif isinstance(schedule, MetaSimSchedule):
            learning = meta_sim_learning(run, observer, guide, _some(target, ~held, schedule.images), schedule, device)
        else:
            assert isinstance(schedule, TiltingSchedule)
            boxes = given_boxes(run, target)
            margins = {} if boxes is None else box_margins(run.model, boxes, target)
            if boxes is not None and margins:
                say(margins_said(margins))
                boxes = without_margins(boxes, margins)
            objects = labelled_objects(run, boxes, target)
            some = _some(target, ~held, schedule.images)
            learning = tilting_learning(run, observer, guide, some, schedule, objects, device)
        keep = Checkpointer(run, NAME, learning)

        def each(training: Training, line: dict[str, float]) -> None:
            keep({"stage": NAME, "step": training.done, **line})
            progress(NAME, training.done, training.total, f"loss {line['loss']:.3f}")

        learning.run(each)
        keep.finish()
        if isinstance(learning, ParameterLearning) and isinstance(backbone, RenderBackbone):
            run.write_tensors(READER, counting_state(learning.calibrated.reader))
        kept = {} if learning.guide is None else {**learning.guide.net.state_dict()}
        run.write_parameters(_record(run, guide, learning, _some(target, held, MAX_HELD_OUT)))
        run.write_tensors(NAME, kept)
        (run.path / f"{NAME}-checkpoint.safetensors").unlink(missing_ok=True)
    say(_said(run.parameters))
    with_parameters(run.model, run.config, run.parameters, guide, prefixed(kept))


def _some(images: Images, which: Tensor, most: int) -> Tensor:
    """At most so many of the chosen images, evenly spread, ``(L, C, H, W)`` uint8."""
    rows = which.nonzero().flatten()
    rows = rows[torch.linspace(0, len(rows) - 1, min(most, len(rows))).round().long()]
    return torch.stack([images.load(row) for row in rows.tolist()])


def _record(
    run: RunFolder,
    guide: Guide,
    learning: ParameterLearning | ImageLevelTraining,
    held: Tensor,
) -> dict[str, Any]:
    """For JSON, see ``select_sites``."""
    method = {"method": run.config.parameter_method}
    if not isinstance(learning, ParameterLearning):
        selected = select_sites(run, guide, learning, held)
        return method | {"sites": sites_record(learning, selected.because), **selected.distances}
    assert learning.calibrated.skill is not None
    shares = learning.calibrated.skill.explained.tolist()
    skill = dict(zip((*learning.node_sites, *learning.scene_sites), shares, strict=True))
    found = select_sites(run, guide, learning, held)
    sites = []  # in the program's order, which is that of the network's columns
    for site in learning.sites:
        share, fitted = skill.get(site, torch.nan), site in learning.learnt
        because = site.keeps or learning.calibrated.why_not(site) or found.because.get(site.name, "")
        about = {"name": site.name, "kinds": site.kinds, "learnt": fitted and site.name not in found.because}
        about |= {"fitted": fitted, "skill": share if share == share else None, "because": because}
        sites.append(about | ({"read": found.sites[site.name]} if site.name in found.sites else {}))
    return method | {"sites": sites, **found.distances}


def _said(record: dict[str, Any]) -> str:
    sites, read = record["sites"], record.get("method", LIKELIHOOD) == LIKELIHOOD
    named = [site["name"] + (f" ({site['skill']:.2f})" if read else "") for site in sites if site["learnt"]]
    others = ", ".join(site["name"] for site in sites if not site["learnt"])
    if not named:
        why = "read in renders" if read else "moved"
        return f"No site can be {why}, so position and appearance keep the prior."
    said = f"Learnt sites{', with the explained variance of their readings' * read}: {', '.join(named)}."
    said += f" Sites that keep the prior: {others}." if others else ""
    if record["kept"] != "learnt":
        said += (
            f" All keep the prior, as learnt scenes come no nearer to held-out images (energy distance "
            f"{record['learnt']:.2f}, of the prior {record['prior']:.2f})."
        )
    return said
