"""What other files an OBJ names, and whether they are there: trimesh would leave them out and say nothing."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from probscene.errors import DataError

from .polygons import unfillable

_OPTION = re.compile(r"-(\w+)((?:\s+(?:[-+]?[\d.]+(?:[eE][-+]?\d+)?|on|off))+)\s+")


class Texture(NamedTuple):
    """A picture's path, and what texture coordinates are multiplied by and moved by, v upward."""

    path: str
    scale: tuple[float, ...] = (1.0, 1.0)
    offset: tuple[float, ...] = (0.0, 0.0)


def textures_of(file: Path) -> dict[str, Texture]:
    """The pictures by the materials that name them, of an OBJ and its MTL; PLY and STL name no files.

    Raises:
        DataError: a file that is named and not there, an OBJ with a polygon that trimesh would fill wrongly.
    """
    return _obj(file) if file.suffix.lower() == ".obj" else {}


def _lines(file: Path) -> list[tuple[str, str]]:
    """(keyword, rest) of every line."""
    pairs = (line.strip().partition(" ") for line in _text(file).splitlines())
    return [(word, rest.strip()) for word, _, rest in pairs]


def _text(file: Path) -> str:
    try:
        return file.read_bytes().decode("utf-8", errors="replace").replace("\t", " ")
    except OSError as error:
        raise DataError(f"expected a readable file, got {file} ({error.strerror}).") from None


def _obj(file: Path) -> dict[str, Texture]:
    lines = _lines(file)
    _check_polygons(file, lines)
    used, textures = {rest for word, rest in lines if word == "usemtl"}, {}
    for library in (rest for word, rest in lines if word == "mtllib"):
        if not (mtl := file.parent / library).is_file():
            raise DataError(f"expected the materials of {file} in {mtl}, got no such file; put it there.")
        material = ""
        for word, rest in _lines(mtl):
            if word == "newmtl":
                material = rest
            elif word.lower() == "map_kd" and material in used:
                textures[material] = _texture(file, mtl.parent, rest)
    return textures


def _check_polygons(file: Path, lines: list[tuple[str, str]]) -> None:
    positions, polygons, numbers = [], [], []
    for number, (word, rest) in enumerate(lines, 1):
        if word == "v":
            positions.append(_numbers(rest.split()[:3]))
        elif word == "f" and len(corners := rest.split()) > 3:
            polygons.append([_vertex(corner.partition("/")[0], len(positions)) for corner in corners])
            numbers.append(number)
    if polygons and (at := unfillable(np.array(positions).reshape(-1, 3), polygons)) is not None:
        raise DataError(
            f"expected triangles or convex polygons, got one with a dent in line {numbers[at]} of {file}; "
            "triangulate it."
        )


def _vertex(text: str, before: int) -> int:
    """An OBJ counts from 1, or back from the last one; -1 for what is no number."""
    number = int(text) if text.removeprefix("-").isdecimal() else 0
    return number - 1 if number > 0 else before + number if number < 0 else -1


def _numbers(words: list[str]) -> list[float]:
    """Three; what is no number is left for trimesh to find."""
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = []
    return found if len(found) == 3 else [np.nan] * 3


def _texture(file: Path, folder: Path, text: str) -> Texture:
    """A file's name after options such as ``-s 1 1 1``."""
    name, options = text, {}
    while option := _OPTION.match(name):
        name, options[option[1]] = name[option.end() :], option[2].split()
    path = folder / name.replace("\\", "/")
    if not path.is_file():
        raise DataError(f"expected the texture {name} of {file} in {folder}, got no such file; put it there.")
    try:
        scale, offset = (
            tuple(float(number) for number in (*options.get(key, ()), rest, rest)[:2])
            for key, rest in (("s", 1), ("o", 0))
        )
    except ValueError:
        raise DataError(
            f"expected numbers after -s and -o of the texture {name} of {file}, got {text}; fix them."
        ) from None
    return Texture(str(path), scale, offset)
