"""probscene: learn the distribution of scenes from unlabelled images, then generate labelled ones.

    import probscene as ps

    fit = ps.fit(model, "photos/", "quick")
    fit.generate(10_000, "dataset/", format="coco")

These are the public names. A name is imported when it is first used. Each is defined in one module, which is what the
library itself imports.
"""

import sys as _sys
from importlib import import_module as _import_module
from pathlib import Path as _Path
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING

_checkout = _Path(__file__).resolve().parent.parent
if (_checkout / "pyproject.toml").is_file():  # a plain checkout: probscene.models is models/, and so on
    __path__.append(str(_checkout))

__version__ = "0.2.0"

_APP_MODULES = {
    "api.calls": ("compare", "evaluate", "generate", "predict", "render", "report", "train", "trial"),
    "api.fit": ("fit",),
    "cut_paste.begin": ("BeginOptions", "begin"),
    "datasets.generate": ("DatasetOptions",),
    "detectors.train": ("TrainOptions",),
    "evaluation.labels": ("TargetLabels",),
    "fitting.begin": ("ModelFile",),
    "targets": ("TargetImages",),
    "trial.trial": ("GeneratedSets", "TrainingBudget", "TrialOptions"),
    "fitting.config": ("FitConfig",),
    "fitting.pipeline": ("Execution",),
    "fitting.presets": ("preset",),
    "api.label": ("label",),
    "api.run": ("Run",),
    "datasets.scene_dataset": ("SceneDataset",),
    "loading": ("load_model",),
}
_MODULES = {
    **{f"probscene.app.{module}": names for module, names in _APP_MODULES.items()},
    "probscene.batch": ("RenderBatch", "Renderer"),
    "probscene.dataset": ("ImageFolder",),
    "probscene.derivation": ("Derivation",),
    "probscene.derive": ("derive",),
    "probscene.drawing": ("Atlas", "Drawing", "Sprites"),
    "probscene.enumeration": ("enumerate_derivations",),
    "probscene.errors": (
        "DataError", "GeneratorError", "GrammarError", "MachineError", "ModelError", "ProbsceneError", "RunError",
        "SamplingError",
    ),
    "probscene.generator": ("Command",),
    "probscene.grammar": ("Grammar",),
    "probscene.image_array": ("ImageArray",),
    "probscene.inference.divergence": ("Divergence", "JensenShannon", "KDELogRatio", "MMD"),
    "probscene.inference.features.base": ("FeatureNet", "Features"),
    "probscene.inference.guides.base": ("Guide",),
    "probscene.inference.guides.grammar_vae": ("GrammarVAE",),
    "probscene.inference.guides.lstm": ("LSTMGuide",),
    "probscene.inference.guides.pcfg": ("PCFG",),
    "probscene.inference.objective": ("ScoreFunction", "ScoreFunctionConfig"),
    "probscene.inference.parameters.guide": ("ParameterGuide",),
    "probscene.inference.parameters.sites": ("find_sites",),
    "probscene.inference.pretrain": ("pretrain",),
    "probscene.mesh": ("Mesh",),
    "probscene.model": ("Groups", "SceneModel", "scene_model"),
    "probscene.camera_effects": ("CameraEffects",),
    "probscene.placement": ("separate",),
    "probscene.policy": ("Policy",),
    "probscene.request": ("Objects", "Request"),
    "probscene.sampling": ("Scenes", "sample", "seed_everything"),
    "probscene.scene": ("SceneGraph",),
    "probscene.structure": ("StructurePrior", "counts", "ranked", "weights"),
    "probscene.world": ("Camera", "Ground", "Light", "Meshes", "World"),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
_OLD_MODULE_OF = {"Photo": "probscene.photo"}  # names in the model files that older runs keep

if TYPE_CHECKING:
    from probscene.app.api.calls import compare, evaluate, generate, predict, render, report, train, trial
    from probscene.app.api.fit import fit
    from probscene.app.api.label import label
    from probscene.app.api.run import Run
    from probscene.app.cut_paste.begin import BeginOptions, begin
    from probscene.app.datasets.generate import DatasetOptions
    from probscene.app.datasets.scene_dataset import SceneDataset
    from probscene.app.detectors.train import TrainOptions
    from probscene.app.evaluation.labels import TargetLabels
    from probscene.app.fitting.begin import ModelFile
    from probscene.app.fitting.config import FitConfig
    from probscene.app.fitting.pipeline import Execution
    from probscene.app.fitting.presets import preset
    from probscene.app.loading import load_model
    from probscene.app.targets import TargetImages
    from probscene.app.trial.trial import GeneratedSets, TrainingBudget, TrialOptions
    from probscene.inference.divergence import MMD, Divergence, JensenShannon, KDELogRatio
    from probscene.inference.features.base import FeatureNet, Features
    from probscene.inference.guides.base import Guide
    from probscene.inference.guides.grammar_vae import GrammarVAE
    from probscene.inference.guides.lstm import LSTMGuide
    from probscene.inference.guides.pcfg import PCFG
    from probscene.inference.objective import ScoreFunction, ScoreFunctionConfig
    from probscene.inference.parameters.guide import ParameterGuide
    from probscene.inference.parameters.sites import find_sites
    from probscene.inference.pretrain import pretrain

    from .batch import RenderBatch, Renderer
    from .camera_effects import CameraEffects
    from .dataset import ImageFolder
    from .derivation import Derivation
    from .derive import derive
    from .drawing import Atlas, Drawing, Sprites
    from .enumeration import enumerate_derivations
    from .errors import (
        DataError,
        GeneratorError,
        GrammarError,
        MachineError,
        ModelError,
        ProbsceneError,
        RunError,
        SamplingError,
    )
    from .generator import Command
    from .grammar import Grammar
    from .image_array import ImageArray
    from .mesh import Mesh
    from .model import Groups, SceneModel, scene_model
    from .placement import separate
    from .policy import Policy
    from .request import Objects, Request
    from .sampling import Scenes, sample, seed_everything
    from .scene import SceneGraph
    from .structure import StructurePrior, counts, ranked, weights
    from .world import Camera, Ground, Light, Meshes, World

__all__ = [
    "Atlas", "BeginOptions", "Camera", "CameraEffects", "Command", "DataError", "DatasetOptions", "Derivation",
    "Divergence", "Drawing", "Execution", "FeatureNet", "Features", "FitConfig", "GeneratedSets", "GeneratorError",
    "Grammar", "GrammarError", "GrammarVAE", "Ground", "Groups", "Guide", "ImageArray", "ImageFolder", "JensenShannon",
    "KDELogRatio", "LSTMGuide", "Light", "MMD", "MachineError", "Mesh", "Meshes", "ModelError", "ModelFile", "Objects",
    "PCFG", "ParameterGuide", "Policy", "ProbsceneError", "RenderBatch", "Renderer", "Request", "Run", "RunError",
    "SamplingError", "SceneDataset", "SceneGraph", "SceneModel", "Scenes", "ScoreFunction", "ScoreFunctionConfig",
    "Sprites", "StructurePrior", "TargetImages", "TargetLabels", "TrainOptions", "TrainingBudget", "TrialOptions",
    "World", "begin", "compare", "counts", "derive", "enumerate_derivations", "evaluate", "find_sites", "fit",
    "generate", "label", "load_model", "predict", "preset", "pretrain", "ranked", "render", "report", "sample",
    "scene_model", "seed_everything", "separate", "train", "trial", "weights",
]  # fmt: skip


class _PublicApi(_ModuleType):
    """A package whose ``derive`` is the function, though a module has the same name: importing a submodule would bind
    the module to that name."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _MODULE_OF and isinstance(value, _ModuleType)):
            super().__setattr__(name, value)


_sys.modules[__name__].__class__ = _PublicApi


def __getattr__(name: str) -> object:
    module = _MODULE_OF.get(name) or _OLD_MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(_import_module(module), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
