"""``probscene.fit``."""

import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from probscene.errors import ProbsceneError
from probscene.inference.divergence import Divergence
from probscene.inference.features.base import FeatureNet, Features
from probscene.model import SceneModel

from ..arguments import checked_seed
from ..evaluation.evaluate import warn_of_saturated_lists
from ..fitting import session
from ..fitting.overrides import override
from ..fitting.plugins import GuideMaker, Plugins, in_memory, is_file_part, lasting_word, load_part
from ..fitting.preset import BOTH, FOR_PHOTOGRAPHS, FOR_RENDERS, STRUCTURE, Preset
from ..fitting.presets import preset as preset_of
from ..loading import load_model
from ..targets import Target
from ..workers.cluster import connected
from ..workers.processes import end_if_starting
from .calls import display
from .run import Run, parts_of


def fit(
    model: SceneModel | Path | str,
    target: Target,
    preset: str | Preset = "default",
    seed: int = 0,
    *,
    features: str | Features | FeatureNet | None = None,
    divergence: str | Divergence | None = None,
    guide: str | GuideMaker | None = None,
    renderer: Any = None,
    out: Path | str | None = None,
    learn: str | None = None,
    parameters: str | None = None,
    settings: Mapping[str, Any] | Sequence[str] = (),
    skip_bad: bool = False,
    threads: int | None = None,
    assets: Path | str | None = None,
    cache: Path | str | bool = True,
    labels: Path | str | None = None,
    resume: bool = False,
    progress: bool = True,
    cluster: str | None = None,
    value_range: Sequence[float] | None = None,
) -> Run:
    """Learn which structures occur in unlabelled images.

    Args:
        model: a scene model, the name of a built-in one, or a Python file.
        target: a folder of PNG, JPEG or TIFF files, a list of files or of Pillow images, an array ``(L, H, W)`` or
            ``(L, H, W, 1 or 3)``, or a torch dataset of images; see ``ImageFolder`` and ``ImageArray``.
        preset: how long and how to learn: ``"quick"``, ``"default"``, ``"street"``, ``"paper"``, ``"paper-aerial"``,
            ``"paper-driving"``, or a ``Preset``.
        seed: of everything random.
        features: the feature network: a word as on the command line, ``FILE.py:NAME``, or an object, see ``Features``
            and ``FeatureNet``. Where None, the preset's; of a target that looks unlike renders, or with labels,
            ``"count=efficientnet"`` instead of ``"count"``.
        divergence: what is descended: ``"kde"``, ``"js"``, ``"witness"``, ``"mmd"``, ``FILE.py:NAME``, or a
            ``Divergence``.
        guide: what learns: ``"lstm"``, ``"pcfg"``, ``"grammar-vae"``, ``FILE.py:NAME``, or what makes a guide of a
            grammar and T_max, such as a class.
        renderer: instead of the model's, see ``SceneModel.renderer``.
        out: the folder of the run; a temporary one where None, which ``Run.save`` copies.
        learn: ``"structure"``, or ``"structure,parameters"``, where things stand and how they look as well; the
            preset's where None.
        parameters: how the latter are learnt: ``"likelihood"`` of what is read in the images; ``"tilting"``, by how
            images look as wholes, for photographs; or ``"meta-sim"``, a baseline; what suits the features where None.
        settings: other values of the preset's fields, ``{"batches": 20, "count.steps": 300}``.
        skip_bad: leave out files that do not decode.
        threads: of torch; as ``OMP_NUM_THREADS`` says, else all cores, where None. Another number rounds differently.
        assets: a folder that the model is drawn with.
        cache: whether trained feature networks are taken from the user's cache folder and kept there; or another
            folder.
        labels: of a few of the images, for features that take them: a ``counts.csv``, COCO's ``.json``,
            KITTI's folder ``label_2`` or YOLO's ``labels``.
        resume: go on with the run in ``out`` where there is one; the other arguments are those that it was begun with.
            Model, target and labels may lie elsewhere by now, if they are the same bytes.
        progress: show it, on stderr.
        cluster: the address of a Ray cluster whose nodes render scenes and read them while structure is learnt, see
            ``Cluster``. They have to see the run's folder by the same path.
        value_range: the values of images of 16 bits that are read as black and white, such as ``(0, 4095)``; where
            None, what is found in the images, see ``ImageFolder``. The run keeps it.

    Raises:
        ProbsceneError: an input is at fault; the message says which and how to fix it. What was finished of the run
            stays, and ``resume=True`` goes on with it.
    """
    settings = with_learn(settings, learn, parameters)
    end_if_starting()
    chosen, parts = chosen_preset(preset, features, divergence, guide, settings)
    other = preset_for_photographs(preset, features, divergence, guide, settings)
    if renderer is not None:
        loaded = model if isinstance(model, SceneModel) else load_model(str(model), assets)
        model = replace(loaded, renderer=renderer)
    given = model if isinstance(model, SceneModel) else str(model)
    folder, temporary = Path(out) if out is not None else None, None
    if folder is None:
        temporary = tempfile.mkdtemp(prefix="probscene-")
        folder = Path(temporary) / "run"
    with display(progress) as show:
        try:
            assets_folder = None if assets is None else Path(assets)
            labels = None if labels is None else Path(labels)
            with connected(cluster, show.say) as nodes:  # first, so that a wrong address leaves no run behind
                if resume and (folder / "run.json").exists():
                    begun = {"seed": seed, "skip_bad": skip_bad, "threads": threads, "labels": labels}
                    begun["value_range"] = value_range
                    run, images = session.resume(
                        folder, show, given, target, chosen, assets_folder, parts, Run, photographs=other, **begun
                    )
                else:
                    run, images = session.begin(
                        given,
                        target,
                        folder,
                        chosen,
                        checked_seed(seed),
                        skip_bad,
                        threads,
                        show,
                        assets_folder,
                        parts,
                        Run,
                        labels,
                        other,
                        value_range,
                    )
                if not run.is_finished:
                    session.carry_out(run, images, show, *_cache(cache), nodes)
                    warn_of_saturated_lists(run, show)
        except BaseException:
            if temporary is not None:
                shutil.rmtree(temporary, ignore_errors=True)
            raise
    if temporary is not None:
        weakref.finalize(run, shutil.rmtree, temporary, True)
    return cast(Run, run)


def chosen_preset(
    preset: str | Preset,
    features: str | Features | FeatureNet | None,
    divergence: str | Divergence | None,
    guide: str | GuideMaker | None,
    settings: Mapping[str, Any] | Sequence[str],
    instead: str = FOR_PHOTOGRAPHS,
) -> tuple[Preset, Plugins]:
    """The preset with all that was chosen beside it, and the user's own parts of it, of objects and of files; arguments
    as of ``fit``.

    Args:
        instead: features that the fit may take where none are chosen, or had before; their settings are read, too.
    """
    chosen = preset if isinstance(preset, Preset) else preset_of(preset)
    is_open = instead == FOR_RENDERS or (features is None and chosen.features == FOR_RENDERS)
    imported: dict[Path, ModuleType] = {}
    given = (features, divergence, guide)
    own = parts_of(*(_part(part, imported) for part in given))
    of_features, of_divergence, of_guide = (lasting_word(part) if isinstance(part, str) else "" for part in given)
    if own.divergence is not None:
        chosen = replace(chosen, objective=of_divergence or in_memory(_name(own.divergence)))
    elif of_divergence:
        chosen = chosen.with_objective(of_divergence)
    if own.guide is not None:
        chosen = replace(chosen, guide=of_guide or in_memory(_name(own.guide)))
    elif of_guide:
        chosen = chosen.with_guide(of_guide)
    other = chosen.with_features(instead) if is_open else None
    if own.features is not None:
        chosen = chosen.with_features_of(own.features, of_features or in_memory(own.features.name))
    elif of_features:
        chosen = chosen.with_features(of_features)
    return override(chosen, with_learn(settings, None), other), own


def with_learn(
    settings: Mapping[str, Any] | Sequence[str], learn: str | None, parameters: str | None = None
) -> list[str]:
    """Settings as words ``key=value``, and what is to be learnt among them, and how; who says how parameters are learnt
    means that they are.

    Raises:
        ProbsceneError: only structure is to be learnt, and yet it is said how parameters are.
    """
    if parameters is not None and learn == STRUCTURE:
        raise ProbsceneError(
            f"expected learn={BOTH} where parameters={parameters} says how, got learn={STRUCTURE}; leave one out."
        )
    learn = BOTH if learn is None and parameters is not None else learn
    words = [f"{key}={_word(value)}" for key, value in settings.items()] if isinstance(settings, Mapping) else settings
    more = {"learn": learn, "parameter_method": parameters}
    return [*words, *(f"{key}={word}" for key, word in more.items() if word is not None)]


def preset_for_photographs(
    preset: str | Preset,
    features: str | Features | FeatureNet | None,
    divergence: str | Divergence | None,
    guide: str | GuideMaker | None,
    settings: Mapping[str, Any] | Sequence[str],
) -> Preset | None:
    """The preset for a target that looks unlike renders; None where features were chosen, or the preset's are not those
    for renders. Arguments as of ``fit``."""
    chosen = preset if isinstance(preset, Preset) else preset_of(preset)
    if features is not None or chosen.features != FOR_RENDERS:
        return None
    made = chosen_preset(preset, FOR_PHOTOGRAPHS, divergence, guide, settings, FOR_RENDERS)[0]
    return made if made.features == FOR_PHOTOGRAPHS else None


def _part(given: Any, imported: dict[Path, ModuleType]) -> Any:
    """An object, or what a word names in a file; None for the library's words."""
    if not isinstance(given, str):
        return given
    return load_part(given, imported) if is_file_part(given) else None


def _name(part: Any) -> str:
    return getattr(part, "__name__", type(part).__name__)


def _word(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def _cache(cache: Path | str | bool) -> tuple[Path | None, bool]:
    return (None, cache) if isinstance(cache, bool) else (Path(cache), True)
