"""``--set key=value``: other values for single fields of a preset."""

import math
import types
from dataclasses import fields, is_dataclass, replace
from typing import Any, Union, get_args, get_origin, get_type_hints

from probscene.errors import ProbsceneError
from probscene.inference.objective import BASELINES

from .plugins import lasting_word
from .preset import BOTH, LIKELIHOOD, META_SIM, STRUCTURE, TILTING, Preset

CHOICES = {
    "baseline": BASELINES,
    "learn": (STRUCTURE, BOTH),
    "parameter_method": (LIKELIHOOD, TILTING, META_SIM),
}
LEAST = {
    "num_scenes": 2,
    "scenes": 2,
    "batches": 0,
    "batches_again": 0,
    "rounds": 0,
    "energy_steps": 0,
    "weighted_scenes": 0,
    "directions": 0,
    "reuse": 0,
}
FIRST = {"objective": Preset.with_objective, "guide": Preset.with_guide, "features": Preset.with_features}
ABOVE_ZERO = ("learning_rate", "variance", "marginal_variance", "scale", "pretrain_rate", "difference")


def override(preset: Preset, settings: list[str], other: Preset | None = None) -> Preset:
    """A preset with ``settings`` such as ``"batches=2"``, ``"count.steps=32"`` or ``"width=8,16,32"``.

    ``none`` stands for no value, ``true`` and ``false`` for themselves. Objective, guide and features come first, with
    all that suits them, as by ``Preset.with_objective`` and the like.

    Args:
        other: another preset that the fit may come to take, or began with: what this one reads may be set, too.

    Raises:
        ProbsceneError: no ``=``, an unknown field, a value of another type or out of range, a setting that nothing
            reads, or one that leaves nothing to learn.
    """
    pairs = []
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise ProbsceneError(f"expected --set key=value, got {setting!r}.")
        pairs.append((key.strip(), text.strip()))
    preset = _applied(preset, pairs)
    unread = preset.unread()
    if other is not None:
        unread = {name: because for name, because in unread.items() if name in _applied(other, pairs).unread()}
    for key, _ in pairs:
        if because := unread.get(key.partition(".")[0]):
            raise ProbsceneError(f"expected settings that are read, got --set {key}=...: {because}; leave it out.")
    if preset.objective == "mmd" and preset.baseline == "leave_one_out":
        raise ProbsceneError(
            "expected a baseline of moving_average or none with objective=mmd, got leave_one_out: all scenes share "
            "one cost, so that their advantages would all be 0."
        )
    if preset.batches == 0 and preset.learn == STRUCTURE:
        raise ProbsceneError(
            f"expected batches of at least 1 where structure alone is learnt, got 0; add learn={BOTH} to learn "
            "parameters in the structures that guides are pretrained on."
        )
    return preset


def _applied(preset: Preset, pairs: list[tuple[str, str]]) -> Preset:
    for key, text in sorted(pairs, key=lambda pair: pair[0] not in FIRST):
        if key in FIRST:
            preset = FIRST[key](preset, lasting_word(text))
        else:
            preset = _replaced(preset, key.split("."), text, key)
    return preset


def _replaced(value: Any, path: list[str], text: str, key: str) -> Any:
    name, *rest = path
    known = [field.name for field in fields(value)]
    if name not in known:
        where = f" of {key.rpartition('.')[0]}" if "." in key else ""
        raise ProbsceneError(f"expected a setting{where} among {', '.join(known)}, got {key!r} in --set.")
    inner = getattr(value, name)
    if rest and not is_dataclass(inner):
        raise ProbsceneError(f"expected --set {key.removesuffix('.' + '.'.join(rest))}=..., got {key!r}.")
    if is_dataclass(inner):
        if not rest:
            raise ProbsceneError(f"expected --set {key}.{fields(inner)[0].name}=..., got {key!r} alone.")
        return replace(value, **{name: _replaced(inner, rest, text, key)})
    new = _read(text, get_type_hints(type(value))[name], key)
    if isinstance(new, str):
        new = lasting_word(new)
    _check(name, new, key)
    return replace(value, **{name: new})


def _read(text: str, wanted: Any, key: str) -> Any:
    if isinstance(wanted, types.UnionType) or get_origin(wanted) is Union:
        if text.lower() == "none":
            return None
        (wanted,) = (kind for kind in get_args(wanted) if kind is not types.NoneType)
    try:
        if get_origin(wanted) is tuple:
            parts = [part.strip() for part in text.strip("()").split(",")]
            return tuple(kind(part) for kind, part in zip(get_args(wanted), parts, strict=True))
        if wanted is bool:
            return {"true": True, "false": False}[text.lower()]
        return wanted(text)
    except (KeyError, ValueError):
        kind = wanted.__name__ if isinstance(wanted, type) else str(wanted)
        raise ProbsceneError(f"expected --set {key}=<{kind}>, got {text!r}.") from None


def _check(name: str, value: Any, key: str) -> None:
    if isinstance(value, str) and value not in CHOICES[name]:
        raise ProbsceneError(f"expected --set {key}=... among {', '.join(CHOICES[name])}, got {value!r}.")
    if type(value) is int and value < LEAST.get(name, 1):
        raise ProbsceneError(f"expected --set {key}=... of at least {LEAST.get(name, 1)}, got {value}.")
    if type(value) is float and not (math.isfinite(value) and (value > 0 or (value == 0 and name not in ABOVE_ZERO))):
        least = "above 0" if name in ABOVE_ZERO else "of at least 0"
        raise ProbsceneError(f"expected --set {key}=... {least}, got {value}.")
