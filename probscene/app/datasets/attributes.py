"""The program's own values as attributes of annotations. Axis letters: N scenes, M nodes."""

from collections.abc import Iterable
from typing import Any

from probscene.errors import ProbsceneError
from probscene.model import SceneModel
from probscene.sampling import Scenes

from .provenance import exact


def chosen(values: str | Iterable[str]) -> tuple[str, ...]:
    """Names of sites, each once, in the order in which they come.

    Args:
        values: names, each of which may be several with commas between them.
    """
    parts = [values] if isinstance(values, str) else values
    return tuple(dict.fromkeys(name.strip() for part in parts for name in part.split(",") if name.strip()))


def check(model: SceneModel, scenes: Scenes, names: tuple[str, ...]) -> None:
    """See that the model's program has these sites.

    Raises:
        ProbsceneError: it lacks one.
    """
    for name in names:
        if name not in scenes.parameters:
            raise ProbsceneError(
                f"expected values among the sites of model {model.name!r} ({', '.join(scenes.parameters) or 'none'}), "
                f"got {name!r}; pyro.deterministic makes a site of any other value."
            )


class Attributes:
    """What annotations say of the program's sites.

    Args:
        names: of the sites.
    """

    def __init__(self, scenes: Scenes, names: tuple[str, ...]):
        self._parent = scenes.derivation.parent.tolist()
        self._sites = {name: (exact(scenes.parameters[name]), scenes.site_mask[name].tolist()) for name in names}

    def __call__(self, scene: int, node: int) -> dict[str, Any]:
        """By site its value at the node, else at the nearest node above that has it; of sites of the scene, the
        scene's. What none of them has is left out."""
        found = {}
        for name, (values, masks) in self._sites.items():
            mask = masks[scene]
            at = 0 if len(mask) == 1 else node
            while at >= 0 and not (at < len(mask) and mask[at]):
                at = self._parent[scene][at]
            if at >= 0:
                found[name] = values[scene][at]
        return found
