"""From a structure to a drawing and back: run a model's Pyro program on given derivations.

Axis letters: N scenes, M nodes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import pyro
import torch
from pyro import poutine
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from .derivation import Derivation
from .derive import derive_complete
from .drawing import Drawing
from .errors import ModelError
from .model import SceneModel
from .policy import Policy
from .world import World


@dataclass(frozen=True, eq=False)
class Scenes:
    """A batch of scenes.

    Attributes:
        derivation: their structures T.
        parameters: alpha, the values of the program's other sites, each ``(N, M)``, ``(N, 1)`` or with an event tail.
        site_mask: where each parameter exists, the mask of its site, ``(N, M)`` or ``(N, 1)`` bool.
        log_prob: ``(N,)`` log q(alpha | T).
        drawing: what to render.
        failures: ``(N,)`` failed attempts at a complete derivation; zeros if the derivations were given.
    """

    derivation: Derivation
    parameters: dict[str, Tensor]
    site_mask: dict[str, Tensor]
    log_prob: Tensor
    drawing: Drawing | World
    failures: Tensor


def sample(model: SceneModel, policy: Policy, num_scenes: int) -> Scenes:
    """Scenes with complete structures from ``policy`` and parameters from the model's program.

    Raises:
        SamplingError: the policy hardly ever ends within the model's ``max_steps``.
        ModelError: see ``run_program``.
    """
    derivation, failures = derive_complete(model.grammar, policy, num_scenes, model.max_steps)
    return run_program(model, derivation, failures=failures)


def run_program(
    model: SceneModel | Callable[[int], Drawing | World],
    derivation: Derivation,
    parameters: dict[str, Tensor] | None = None,
    failures: Tensor | None = None,
) -> Scenes:
    """Run a model's program on given derivations, and on given parameters where there are any.

    Args:
        model: a scene model, or a Pyro program that is called with the number of scenes.

    Raises:
        ModelError: the program's sites are not what a scene model's must be, or it returns no ``Drawing``.
    """
    N = len(derivation)
    sites = derivation.sites()
    name = getattr(model, "name", getattr(model, "__name__", "?"))
    with torch.no_grad(), poutine.block():
        program = poutine.condition(model, data={**sites, **(parameters or {})})
        trace = poutine.trace(program).get_trace(N)
    drawing = trace.nodes["_RETURN"].get("value")
    if not isinstance(drawing, Drawing | World) or len(drawing) != N:
        raise ModelError(
            f"Expected the program of model {name!r} to return a Drawing or a World of {N} scenes (scene.draw(...) "
            f"or scene.build(...)), actual {type(drawing).__name__}."
        )
    values, site_mask = {}, {}
    log_prob = torch.zeros(N)
    for key, site in cast(dict[str, Any], trace.nodes).items():
        if site["type"] != "sample" or key in sites or site_is_subsample(site):
            continue
        value, mask = site["value"], site["mask"]
        if value.ndim < 2 or value.shape[0] != N:
            raise ModelError(
                f"Expected site {key!r} of model {name!r} inside the scenes plate, shape ({N}, nodes), "
                f"actual {tuple(value.shape)}; sample it inside scene.nodes(...) or the plate 'scenes' (dim=-2)."
            )
        logp = site["fn"].log_prob(value)
        mask = torch.ones(logp.shape, dtype=torch.bool) if mask is None else torch.as_tensor(mask).expand(logp.shape)
        values[key], site_mask[key] = value, mask
        log_prob = log_prob + logp.where(mask, 0.0).sum(-1)
    return Scenes(
        derivation,
        values,
        site_mask,
        log_prob,
        drawing,
        torch.zeros(N, dtype=torch.int64) if failures is None else failures,
    )


def log_prob(policy: Policy, scenes: Scenes) -> Tensor:
    """``log q(T, alpha) = log q(T) + log q(alpha | T)``, ``(N,)`` (section 3.2)."""
    return policy.log_prob(scenes.derivation) + scenes.log_prob


def seed_everything(seed: int) -> None:
    """Seed torch, numpy and ``random`` through Pyro."""
    pyro.set_rng_seed(seed)
