"""Parts of a fit that a user brings: features, a divergence, a guide; by object or as ``FILE.py:NAME``.

Each is checked where it is first used, so that what it returns wrongly is named at the first batch and not by a matrix
product an hour later. Axis letters: N scenes, L images, D features, T steps, K rules.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from probscene.derivation import Derivation
from probscene.derive import derive_complete
from probscene.errors import ModelError, ProbsceneError, RunError
from probscene.grammar import Grammar
from probscene.inference.divergence import Divergence
from probscene.inference.features.base import FeatureNet, Features, Fixed
from probscene.inference.guides.base import Guide
from probscene.policy import Policy

from ..modules import import_file

IN_MEMORY = "object:"  # begins the word that a run records of a part that is no file's

GuideMaker = Callable[[Grammar, int], Guide]
"""Makes an untrained guide of a grammar and T_max."""


@dataclass(frozen=True)
class Parts:
    """What a user brings as objects; None for what the preset names."""

    features: Features | None = None
    divergence: Divergence | None = None
    guide: GuideMaker | None = None


def is_file_part(word: str) -> bool:
    """Whether a word has the form ``FILE.py:NAME``."""
    return ".py:" in word


def part_file(word: str) -> Path:
    """The file of a word ``FILE.py:NAME``."""
    return Path(word.rpartition(":")[0])


def lasting_word(word: str) -> str:
    """A word ``FILE.py:NAME`` that means the same from every folder; any other as it is."""
    return f"{part_file(word).resolve()}:{word.rpartition(':')[2]}" if is_file_part(word) else word


def load_part(word: str) -> Any:
    """What ``FILE.py:NAME`` names.

    Raises:
        ModelError: the file does not import, or has no such name.
    """
    name = word.rpartition(":")[2]
    module = import_file(part_file(word))
    if not hasattr(module, name):
        raise ModelError(f"Expected {name} in {part_file(word)}, actual none; write FILE.py:NAME with a name it has.")
    return getattr(module, name)


def as_features(given: Any) -> Features:
    """Features from an object, or from a class that is made without arguments: ``Features``, or a network with
    ``names`` and ``embed``, which is taken as it is.

    Raises:
        ModelError: something else.
    """
    made = given() if isinstance(given, type) else given
    if callable(getattr(made, "build", None)) and isinstance(getattr(made, "name", None), str):
        return made
    if callable(getattr(made, "embed", None)) and hasattr(made, "names"):
        return Fixed(made)
    raise ModelError(
        f"Expected features with a name and build(model), or a network with names and embed(images), actual "
        f"{type(made).__name__}; see probscene.Features."
    )


def as_divergence(given: Any) -> Divergence:
    """A divergence from an object, a function, or a class that is made without arguments.

    Raises:
        ModelError: it cannot be called.
    """
    made = given() if isinstance(given, type) else given
    if not callable(made):
        raise ModelError(
            f"Expected a divergence, called with features (N, D) and (L, D), actual {type(made).__name__}."
        )
    return cast(Divergence, made)


def as_guide_maker(given: Any) -> GuideMaker:
    """What makes guides: a class of guides or a function.

    Raises:
        ModelError: it cannot be called.
    """
    if isinstance(given, Policy) or not callable(given):
        raise ModelError(
            f"Expected a class of guides or a function guide(grammar, max_steps), actual {type(given).__name__}; every "
            "fit makes its own."
        )
    return cast(GuideMaker, given)


class CheckedNet:
    """A user's feature network, whose first answer is looked at."""

    def __init__(self, net: FeatureNet):
        self.net, self.names = net, tuple(net.names)
        self._checked = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.net, name)

    def embed(self, images: Tensor) -> Tensor:
        """``(N, D)``, see ``FeatureNet``.

        Raises:
            ModelError: something else, or another answer to the same image.
        """
        found = self.net.embed(images)
        where = f"{type(self.net).__name__}.embed"
        _check_tensor(found, (len(images), len(self.names)), where, "features (N, D), one column a name")
        if not self._checked and len(images):
            alone = self.net.embed(images[:1])
            if alone.shape != found[:1].shape or not torch.allclose(alone, found[:1], rtol=1e-4, atol=1e-5):
                raise ModelError(
                    f"Expected {where} to give an image the same features alone and in a batch, actual others; use no "
                    "statistics of the batch and no random numbers, and call eval()."
                )
            self._checked = True
        return found.detach()


def inner(net: FeatureNet) -> FeatureNet:
    """The network itself, without the checks around a user's."""
    return net.net if isinstance(net, CheckedNet) else net


def state_of(net: FeatureNet) -> dict[str, Tensor]:
    """What a run keeps of a feature network: a module's state, of anything else nothing."""
    module = inner(net)
    return module.state_dict() if isinstance(module, nn.Module) else {}


def load_state(net: FeatureNet, tensors: dict[str, Tensor]) -> None:
    """The reverse of ``state_of``; the network is then ready for use.

    Raises:
        RunError: the state is another network's.
    """
    module = inner(net)
    if not isinstance(module, nn.Module):
        return
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        raise RunError(
            f"Expected the state of a {type(module).__name__}, actual another network's; put the features back as they "
            "were when the run was begun, or fit again."
        ) from error
    module.eval()


class CheckedDivergence:
    """A user's divergence, whose answers are looked at."""

    def __init__(self, divergence: Divergence):
        self.divergence = divergence

    def __call__(self, generated: Tensor, real: Tensor) -> Tensor:
        """``(N,)``, see ``Divergence``.

        Raises:
            ModelError: something else.
        """
        cost = self.divergence(generated, real)
        what = getattr(self.divergence, "__name__", None) or f"{type(self.divergence).__name__}.__call__"
        _check_tensor(cost, (len(generated),), what, "one cost a generated scene (N,)")
        return cost.detach()


def check_guide(guide: Any, max_steps: int) -> Guide:
    """A user's guide, run once on its own grammar.

    Raises:
        ModelError: it is no module and policy, or its logits or log-probabilities are of a wrong shape, type or value,
            or differ between two calls.
    """
    name = type(guide).__name__
    is_guide = isinstance(guide, nn.Module) and isinstance(guide, Policy) and hasattr(guide, "grammar")
    if not is_guide:
        raise ModelError(
            f"Expected a guide that is a torch.nn.Module and a Policy, actual {name}; subclass probscene.Guide."
        )
    checked = cast(Guide, guide)
    if not any(p.requires_grad for p in checked.parameters()):
        raise ModelError(f"Expected a guide with parameters to learn, actual {name} with none.")
    with torch.no_grad():
        derivation, _ = derive_complete(checked.grammar, _Logits(checked, name), 4, max_steps)
        found = [checked.log_prob(derivation) for _ in range(2)]
    _check_tensor(found[0], (4,), f"{name}.log_prob", "one log-probability a derivation (N,)")
    if not torch.equal(*found):
        raise ModelError(f"Expected {name}.log_prob to say the same of the same derivations, actual two; call eval().")
    return checked


class _Logits(Policy):
    """A guide whose steps are looked at."""

    def __init__(self, guide: Guide, name: str):
        self.guide, self.name, self.grammar = guide, name, guide.grammar

    def start(self, num_scenes: int) -> Any:
        return self.guide.start(num_scenes)

    def step(self, memory: Any, frontier: Any, previous_rule: Tensor) -> tuple[Tensor, Any]:
        found = self.guide.step(memory, frontier, previous_rule)
        if not isinstance(found, tuple) or len(found) != 2:
            raise ModelError(f"Expected (logits, memory) of {self.name}.step, actual {type(found).__name__}.")
        shape = (len(previous_rule), len(self.grammar.rules))
        _check_tensor(found[0], shape, f"{self.name}.step", "logits (N, K), one column a rule")
        return found

    def log_prob(self, derivation: Derivation) -> Tensor:
        return self.guide.log_prob(derivation)


def _check_tensor(found: Any, shape: tuple[int, ...], where: str, what: str) -> None:
    if not isinstance(found, Tensor) or tuple(found.shape) != shape or not found.is_floating_point():
        actual = f"{found.dtype} {tuple(found.shape)}" if isinstance(found, Tensor) else type(found).__name__
        raise ModelError(f"Expected of {where} {what}: a float tensor {shape}, actual {actual}.")
    if not torch.isfinite(found).all():
        raise ProbsceneError(f"Expected finite values of {where}, actual NaN or infinity.")
