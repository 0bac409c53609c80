"""A folder of meshes of one's own: OBJ, glTF, GLB, PLY or STL files, one subfolder a kind of thing.

    assets/car/saloon.glb    assets/car/taxi@4.6m.obj    assets/tree/oak.glb

Subfolders are named as the kinds of ``street_assets``; what a folder lacks is drawn with the project's own meshes.

Which way is forward: glTF, GLB and OBJ have y up and face +z, as the glTF specification says; PLY and STL have z up and
face +x. A mesh is put on the ground and centred. Its unit is the metre; a file whose name ends in ``@4.6m`` is scaled
as a whole until what ``SIZES`` measures is 4.6 m, one that ends in ``@4.6x1.8x1.5m`` to that length, width and height.
A material whose name holds "paint" or "tint" takes the colours that
a model gives to its things; all other colours and textures stay as they are, those of glTF converted to sRGB.
"""

import hashlib
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from probscene.errors import DataError
from probscene.mesh import Mesh

from ..things.catalogue import DECORATION, KINDS, street
from .reader import SUFFIXES, Fields, read


class Size(NamedTuple):
    """What is measured, along which axis, and between how many metres it is plausible."""

    what: str
    axis: int
    low: float
    high: float


SIZES = {
    "car": Size("long", 0, 2.2, 6.5),
    "van": Size("long", 0, 3.0, 8.0),
    "truck": Size("long", 0, 3.5, 20.0),
    "building": Size("high", 2, 2.0, 150.0),
    "tree": Size("high", 2, 1.5, 45.0),
    "bush": Size("high", 2, 0.2, 5.0),
    "pole": Size("high", 2, 1.5, 16.0),
    "sign": Size("high", 2, 0.8, 9.0),
    "pedestrian": Size("high", 2, 0.7, 2.3),
    "cyclist": Size("long", 0, 1.1, 2.6),
    "object": Size("high", 2, 0.1, 6.0),
    "slab": Size("long", 0, 0.5, 200.0),
    "kerb": Size("long", 0, 0.5, 200.0),
    "lawn": Size("long", 0, 0.5, 200.0),
    "fence": Size("long", 0, 0.5, 50.0),
}
LENGTHWAYS = ("car", "van", "truck", "cyclist")  # longer than wide
_OTHER = (".3ds", ".blend", ".dae", ".fbx", ".off", ".step", ".stp", ".usd", ".usda", ".usdc", ".usdz", ".x3d")
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "feet": 0.3048}
_NAMED = re.compile(r"@(\d+\.?\d*)(?:x(\d+\.?\d*)x(\d+\.?\d*))?m$")


@cache
def folder(path: str | Path) -> dict[str, tuple[Mesh, ...]]:
    """Meshes by kind, in the order of the files' names; every kind and decoration of ``street()``.

    Raises:
        DataError: the folder or a file in it cannot be used: no folder, a subfolder of an unknown kind or without
            meshes, a mesh that is empty, not of triangles, not finite, of an implausible size, turned sideways, of more
            than 200,000 triangles, or a texture or other file that it names and that is not there.
    """
    root = Path(path)
    if not root.is_dir():
        raise DataError(f"expected a folder of meshes, got {root}, which is none; put it there, or name another.")
    found = {}
    for sub in sorted(p for p in root.iterdir() if not p.name.startswith((".", "__"))):
        if not sub.is_dir():
            if sub.suffix.lower() in SUFFIXES:
                raise DataError(f"expected meshes in a subfolder for their kind, got {sub}; put it into {root}/car.")
            continue
        if sub.name not in SIZES:
            kinds = ", ".join((*KINDS, *DECORATION))
            raise DataError(f"expected subfolders among {kinds}, got {sub}; rename or remove it.")
        there = sorted(p for p in sub.iterdir() if not p.name.startswith("."))
        files = [p for p in there if p.suffix.lower() in SUFFIXES]
        for other in (p for p in there if p.suffix.lower() in _OTHER):
            raise DataError(f"expected meshes as {', '.join(SUFFIXES)}, got {other}; export it as .glb or remove it.")
        if not files:
            raise DataError(f"expected mesh files ({', '.join(SUFFIXES)}) in {sub}, got none; add one or remove it.")
        found[sub.name] = tuple(_checked(file, sub.name) for file in files)
    if not found:
        raise DataError(f"expected subfolders such as car with mesh files in {root}, got none; add one.")
    return {**street(), **found}


@cache
def described(path: str | Path) -> str:
    """Which meshes ``folder`` gives, in words: where they are, and a digest of all that the folder holds.

    Raises:
        DataError: see ``folder``.
    """
    folder(path)
    digest, root = hashlib.sha256(), Path(path)
    for file in sorted(p for p in root.rglob("*") if p.is_file() and not p.name.startswith(".")):
        data = hashlib.sha256(file.read_bytes()).digest()
        digest.update(file.relative_to(root).as_posix().encode("utf-8", "surrogateescape") + b"\0" + data)
    return f"meshes in {root} ({digest.hexdigest()[:12]})"


def _checked(file: Path, kind: str) -> Mesh:
    """The mesh of a file as it stands on the street, of a size that its kind can have."""
    parts = read(file)
    size = SIZES[kind]
    if named := _NAMED.search(file.stem):
        _scale(parts, file, [float(number) for number in named.groups() if number], size.axis)
    low, high = parts["positions"].min(0), parts["positions"].max(0)
    extent = high - low
    measured = float(extent[size.axis])
    if not size.low <= measured <= size.high:
        raise DataError(
            f"expected a {kind} {size.low:g} to {size.high:g} m {size.what}, got {measured:.3g} m in {file}; "
            f"{_remedy(file, measured, size)}."
        )
    if kind in LENGTHWAYS and extent[1] > 1.2 * extent[0]:
        raise DataError(
            f"expected a {kind} longer than wide, got {extent[0]:.3g} m long and {extent[1]:.3g} m wide in {file}; "
            "turn it until it faces +z where y is up (glTF, OBJ), or +x where z is (PLY, STL)."
        )
    if extent.max() > 200:
        raise DataError(f"expected a mesh of at most 200 m, got {extent.max():.4g} m in {file}; scale it.")
    parts["positions"] = parts["positions"] - [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]
    return Mesh(**parts)


def _scale(parts: Fields, file: Path, metres: list[float], axis: int) -> None:
    """As the file's name says; corner normals turn with the faces."""
    extent = np.ptp(parts["positions"], axis=0)
    wanted = np.array(metres) if len(metres) == 3 else metres[0] * np.ones(3)
    actual = extent if len(metres) == 3 else extent[axis] * np.ones(3)
    if min(metres) <= 0 or actual.min() <= 0:
        raise DataError(f"expected sizes to scale by above 0 m, got {actual.min():g} m in {file}; rename it.")
    by = wanted / actual
    normals = parts["normals"] / by
    parts["normals"] = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    parts["positions"] = parts["positions"] * by


def _remedy(file: Path, measured: float, size: Size) -> str:
    """What to do about a size: the unit that it fits, and the name that scales it."""
    fitting = [name for name, metres in _UNITS.items() if size.low <= measured * metres <= size.high]
    unit = f"it may be in {' or '.join(fitting)}; " if fitting and measured > size.high else ""
    middle = np.sqrt(size.low * size.high)
    return f"{unit}export it in metres, or rename it to have it scaled, such as {file.stem}@{middle:.1f}m{file.suffix}"
