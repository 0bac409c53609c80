"""From a structure to a drawing and back: run a model's Pyro program on given derivations.

Axis letters: N scenes, M nodes.
"""

import random
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pyro
import torch
from pyro import poutine
from pyro.poutine.util import site_is_subsample
from torch import Tensor
from torch.nn.functional import pad

from .derivation import Derivation
from .derive import ConditionDerivation, derive_complete
from .errors import ModelError
from .model import SceneModel
from .policy import Policy
from .program_errors import remedy, useful_text, user_errors
from .request import Renderable


@dataclass(frozen=True, eq=False)
class Scenes:
    """A batch of scenes.

    Attributes:
        derivation: their structures T.
        parameters: alpha, the values of the program's other sites, each ``(N, M)``, ``(N, 1)`` or with an event tail.
        site_mask: where each parameter exists, the mask of its site, ``(N, M)`` or ``(N, 1)`` bool.
        log_prob: ``(N,)`` log q(alpha | T); NaN where it was not asked for.
        drawing: what to render.
        failures: ``(N,)`` failed attempts at a complete derivation; zeros if the derivations were given.
    """

    derivation: Derivation
    parameters: dict[str, Tensor]
    site_mask: dict[str, Tensor]
    log_prob: Tensor
    drawing: Renderable
    failures: Tensor

    def select(self, which: Tensor) -> "Scenes":
        """Those of a mask ``(N,)`` bool."""
        return Scenes(
            self.derivation[which],
            {name: value[which] for name, value in self.parameters.items()},
            {name: mask[which] for name, mask in self.site_mask.items()},
            self.log_prob[which],
            self.drawing[which],
            self.failures[which],
        )


def sample(model: SceneModel, policy: Policy, num_scenes: int, density: bool = True) -> Scenes:
    """Scenes with complete structures from ``policy`` and parameters from the model's program, or from that of
    ``policy.with_parameters``.

    Args:
        density: whether their ``log_prob`` is asked for; of learnt parameters it takes as long as drawing them.

    Raises:
        SamplingError: the policy hardly ever ends within the model's ``max_steps``.
        ModelError: see ``run_program``.
    """
    derivation, failures = derive_complete(model.grammar, policy, num_scenes, model.max_steps)
    drawn_by = model if policy.with_parameters is None else policy.with_parameters(model)
    return run_program(drawn_by, derivation, None, failures, density)


def run_program(
    model: SceneModel | Callable[[int], Renderable],
    derivation: Derivation,
    parameters: dict[str, Tensor] | None = None,
    failures: Tensor | None = None,
    density: bool = True,
) -> Scenes:
    """Run a model's program on given derivations, and on given parameters where there are any.

    The program's ``derive`` is handed the derivations; they are not expanded again.

    Args:
        model: a scene model, or a Pyro program that is called with the number of scenes.
        derivation: complete derivations.
        density: see ``sample``.

    Raises:
        ModelError: a derivation that is not complete; the program raises an error, which is given with its line; its
            sites are not what a scene model's must be; it returns no ``Drawing``, or one of other nodes than were
            derived.
    """
    N = len(derivation)
    sites = derivation.sites()
    name = getattr(model, "name", getattr(model, "__name__", "?"))
    if not derivation.complete.all():
        raise ModelError(
            f"expected complete derivations for model {name!r}, got {int((~derivation.complete).sum())} of {N} with "
            "nonterminals left; draw them with derive_complete."
        )
    known = ConditionDerivation(model.grammar, derivation) if isinstance(model, SceneModel) else nullcontext()
    with user_errors(f"the program of model {name!r}", model), torch.no_grad(), poutine.block(), known:
        program = poutine.condition(model, data={**sites, **(parameters or {})})
        trace = poutine.trace(program).get_trace(N)
    drawing = trace.nodes["_RETURN"].get("value")
    if not isinstance(drawing, Renderable) or len(drawing) != N:
        raise ModelError(
            f"expected the program of model {name!r} to return a Drawing or a World of {N} scenes (scene.draw(...) "
            f"or scene.build(...)), got {type(drawing).__name__}."
        )
    check_nodes(name, drawing, derivation.trimmed())
    values, site_mask = {}, {}
    log_prob = torch.zeros(N) if density else torch.full((N,), torch.nan)
    for key, site in cast(dict[str, Any], trace.nodes).items():
        if site["type"] != "sample" or key in sites or site_is_subsample(site):
            continue
        value, mask = site["value"], site["mask"]
        if value.ndim < 2 or value.shape[0] != N:
            raise ModelError(
                f"expected site {key!r} of model {name!r} inside the scenes plate, shape ({N}, nodes), "
                f"got {tuple(value.shape)}; sample it inside scene.nodes(...) or the plate 'scenes' (dim=-2)."
            )
        shape = site["fn"].batch_shape
        mask = torch.ones(shape, dtype=torch.bool) if mask is None else torch.as_tensor(mask).expand(shape)
        values[key], site_mask[key] = value, mask
        if density:
            log_prob = log_prob + _site_log_prob(name, key, site).where(mask, 0.0).sum(-1)
    return Scenes(
        derivation,
        values,
        site_mask,
        log_prob,
        drawing,
        torch.zeros(N, dtype=torch.int64) if failures is None else failures,
    )


def _site_log_prob(name: str, key: str, site: dict[str, Any]) -> Tensor:
    try:
        return site["fn"].log_prob(site["value"])
    except (ValueError, RuntimeError, NotImplementedError) as error:
        raise ModelError(
            f"expected a log-probability of the values of site {key!r} of model {name!r}, got "
            f"{type(error).__name__}: {useful_text(error)}; {remedy(error)}."
        ) from error


def check_nodes(name: str, drawing: Renderable, derivation: Derivation) -> None:
    """See that the program of model ``name`` drew the nodes that were derived.

    Raises:
        ModelError: it drew others.
    """
    M = max(drawing.kind.shape[1], derivation.kind.shape[1])
    drawn, derived = (pad(kind, (0, M - kind.shape[1]), value=-1) for kind in (drawing.kind, derivation.kind))
    other = (drawn != derived).any(1)
    if not other.any():
        return
    i, names = int(other.nonzero()[0]), dict(enumerate(drawing.kinds))

    def words(kind: Tensor) -> str:
        return ", ".join(names.get(k, f"kind {k}") for k in kind[kind >= 0].tolist()) or "none"

    raise ModelError(
        f"expected the program of model {name!r} to draw the nodes that were derived, got other ones in scene {i}: "
        f"derived {words(derived[i])}; drawn {words(drawn[i])}. Derive with the model's own grammar and max_steps, a "
        "smaller one cuts scenes short, and draw with the SceneGraph of that derivation; scene_model does both."
    )


def log_prob(policy: Policy, scenes: Scenes) -> Tensor:
    """``log q(T, alpha) = log q(T) + log q(alpha | T)``, ``(N,)`` (section 3.2)."""
    return policy.log_prob(scenes.derivation) + scenes.log_prob


def seed_everything(seed: int) -> None:
    """Seed torch, numpy and ``random``, as ``pyro.set_rng_seed`` does."""
    if torch.cuda.is_available() or torch.backends.mps.is_available():
        pyro.set_rng_seed(seed)
        return
    # Without a GPU torch.manual_seed takes down the whole stack each time, for when there is one.
    torch.default_generator.manual_seed(seed)
    random.seed(seed)
    np.random.seed(seed)
