"""What other files a mesh file names, and whether they are there: trimesh would leave them out and say nothing."""

import json
import re
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np

from probscene.errors import DataError

from .polygons import unfillable


class Sources(NamedTuple):
    """The textures that a file's materials name, and how its colours are meant.

    ``textures``: by material, the picture's path or where it is kept; ``linear_vertices``, ``linear_factors``: whether
    colours of vertices and of materials are linear light and not sRGB.
    """

    textures: dict[str, str]
    linear_vertices: bool = False
    linear_factors: bool = False


def sources(file: Path) -> Sources:
    """Look through an OBJ and its MTL, or a glTF; other formats name no files.

    Raises:
        DataError: a file that is named and not there, a glTF that is none or is compressed, an OBJ with a polygon that
            trimesh would fill wrongly.
    """
    suffix = file.suffix.lower()
    if suffix == ".obj":
        return Sources(_obj(file))
    if suffix not in (".gltf", ".glb"):
        return Sources({})
    try:
        return _gltf(file)
    except (AttributeError, IndexError, KeyError, TypeError):
        raise DataError(f"Expected a glTF whose parts fit together, actual {file}; export it again.") from None


def _lines(file: Path) -> list[tuple[str, str]]:
    """(keyword, rest) of every line."""
    pairs = (line.strip().partition(" ") for line in _text(file).splitlines())
    return [(word, rest.strip()) for word, _, rest in pairs]


def _text(file: Path) -> str:
    try:
        return file.read_bytes().decode("utf-8", errors="replace").replace("\t", " ")
    except OSError as error:
        raise DataError(f"Expected a readable file, actual {file} ({error.strerror}).") from None


def _obj(file: Path) -> dict[str, str]:
    lines = _lines(file)
    _check_polygons(file, lines)
    used, textures = {rest for word, rest in lines if word == "usemtl"}, {}
    for library in (rest for word, rest in lines if word == "mtllib"):
        if not (mtl := file.parent / library).is_file():
            raise DataError(f"Expected the materials of {file} in {mtl}, actual no such file; put it there.")
        material = ""
        for word, rest in _lines(mtl):
            if word == "newmtl":
                material = rest
            elif word.lower() == "map_kd" and material in used:
                textures[material] = _there(file, mtl.parent, _without_options(rest))
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
            f"Expected triangles or convex polygons, actual one with a dent in line {numbers[at]} of {file}; "
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


def _without_options(text: str) -> str:
    """The file's name after options such as ``-s 1 1 1``."""
    return re.sub(r"^(-\w+(\s+(?:-?[\d.]+|on|off))+\s+)+", "", text)


def _there(file: Path, folder: Path, name: str) -> str:
    path = folder / name.replace("\\", "/")
    if not path.is_file():
        raise DataError(f"Expected the texture {name} of {file} in {folder}, actual no such file; put it there.")
    return str(path)


def _gltf(file: Path) -> Sources:
    """glTF's colours are linear; those of vertices in files that trimesh wrote are not."""
    tree = _tree(file)
    packed = [name for name in tree.get("extensionsRequired", []) if "compression" in name]
    if packed:
        raise DataError(f"Expected a plain glTF, actual one that needs {packed[0]} in {file}; export it without.")
    for buffer in tree.get("buffers", []):
        uri = buffer.get("uri", "data:")
        if not uri.startswith("data:") and not (file.parent / unquote(uri)).is_file():
            raise DataError(f"Expected the data {uri} of {file} beside it, actual no such file; put it there.")
    textures, images = {}, tree.get("images", [])
    for material in tree.get("materials", []):
        index = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {}).get("index")
        if index is None:
            continue
        source = tree.get("textures", [{}])[index].get("source")
        if source is None:
            raise DataError(f"Expected textures as PNG or JPEG, actual another format in {file}; export it again.")
        uri, name = images[source].get("uri", "data:"), material.get("name", "")
        embedded = uri.startswith("data:")
        textures[name] = f"the picture inside {file}" if embedded else _there(file, file.parent, unquote(uri))
    written = str(tree.get("asset", {}).get("generator", ""))
    return Sources(textures, linear_vertices="trimesh" not in written, linear_factors=True)


def _tree(file: Path) -> dict:
    """The JSON of a glTF, or of the first chunk of a GLB."""
    try:
        data = file.read_bytes()
        if file.suffix.lower() == ".glb":
            if data[:4] != b"glTF":
                raise ValueError("no GLB")
            data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
        tree = json.loads(data)
        if not isinstance(tree, dict):
            raise ValueError("no object")
        return tree
    except (OSError, ValueError) as error:
        raise DataError(f"Expected a glTF file, actual {file} ({error}); export it again.") from None
