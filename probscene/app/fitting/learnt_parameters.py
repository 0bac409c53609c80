"""Learnt parameters as a run keeps them: the network's tensors beside the guide's, so that one digest is of both."""

from typing import Any

from torch import Tensor

from probscene.inference.parameters.guide import ParameterGuide
from probscene.inference.parameters.meta_sim.schedule import MetaSimSchedule
from probscene.inference.parameters.meta_sim.transform import ParameterTransform
from probscene.inference.parameters.sites import Site
from probscene.model import SceneModel
from probscene.policy import Policy

from .config import META_SIM, FitConfig

NAME = "parameters"  # of the file with the record, and before the names of tensors beside a guide's


def prefixed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of learnt parameters under the names that they have beside a guide's."""
    return {f"{NAME}.{key}": value for key, value in tensors.items()}


def split_tensors(tensors: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """A guide's own tensors, and those of parameters beside them."""
    own = {key: value for key, value in tensors.items() if not key.startswith(f"{NAME}.")}
    return own, {key: value for key, value in tensors.items() if key not in own}


def with_parameters(
    model: SceneModel, config: FitConfig, record: dict[str, Any], policy: Policy, tensors: dict[str, Tensor]
) -> Policy:
    """A policy whose scenes have learnt parameters, in place; as it is where none are kept. Arguments as of
    ``learnt_by``."""
    if tensors and record.get("kept") == "learnt":
        policy.with_parameters = learnt_by(model, config, record, policy, tensors).with_parameters
    return policy


def learnt_by(
    model: SceneModel, config: FitConfig, record: dict[str, Any], policy: Policy, tensors: dict[str, Tensor]
) -> ParameterGuide | ParameterTransform:
    """What was learnt of parameters, whether it is kept or not.

    Args:
        model: of the run.
        config: of the run.
        record: of the run's parameters, see ``Storage.parameters``.
        policy: of the structures.
        tensors: see ``prefixed``.
    """
    fitted = [site for site in record["sites"] if site.get("fitted", site["learnt"])]
    sites = tuple(Site(site["name"], tuple(site["kinds"])) for site in fitted)
    if record.get("method") == META_SIM:
        schedule = config.parameters
        assert isinstance(schedule, MetaSimSchedule)
        guide = ParameterTransform(model, sites, policy, schedule.hidden, schedule.rounds)
    else:
        guide = ParameterGuide(model, sites, policy)
        guide.prior_sites = frozenset(site["name"] for site in fitted if not site["learnt"])
    guide.net.load_state_dict({key.removeprefix(f"{NAME}."): value for key, value in tensors.items()})
    return guide.eval()
