"""The triangles of a glTF or GLB file and their base colours, as glTF 2.0 and some of its extensions have them.

The scene that the file shows is read in its rest pose: nodes, instances, morph weights and skins. Lines and points,
transparency, emission, normal maps and gloss are not drawn.

Specification: Khronos, glTF 2.0, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, and the registry of
extensions beside it. Axis letters: V vertices, F triangles, I instances, J joints.
"""

import base64
import io
import json
import math
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from probscene.errors import DataError

from .part import Part, check_geometry, check_number, decoded, is_tinted, opened

DRAWN = {
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
}
_NUMBERS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_CLAMP, _MIRROR = 33071, 33648
_AT_REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
_GREY = 200.0  # of 255, of what has neither a material nor colours


def parts(file: Path) -> list[Part]:
    """Every primitive that has triangles, where the scene has it; y up, as in the file.

    Raises:
        DataError: the file is no glTF, needs an extension that is not drawn, names a file that is not there or is no
            picture, or its parts do not fit together.
    """
    tree, binary = _chunks(file)
    try:
        with np.errstate(all="ignore"):  # what is not finite is found afterwards
            return _Gltf(file, tree, binary).parts()
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError):
        raise DataError(f"expected a glTF whose parts fit together, got {file}; export it again.") from None


def _chunks(file: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON of a glTF or a GLB, and a GLB's binary data."""
    try:
        data, binary = file.read_bytes(), b""
        if file.suffix.lower() == ".glb":
            if data[:4] != b"glTF":
                raise ValueError("no GLB")
            end = 20 + int.from_bytes(data[12:16], "little")
            data, binary = data[20:end], data[end + 8 : end + 8 + int.from_bytes(data[end : end + 4], "little")]
        tree = json.loads(data)
        if not isinstance(tree, dict):
            raise ValueError("no object")
        return tree, binary
    except (OSError, ValueError) as error:
        raise DataError(f"expected a glTF file, got {file} ({error}); export it again.") from None


class _PlacedNode(NamedTuple):
    """A node that is shown, and its matrix in the scene."""

    node: dict[str, Any]
    matrix: np.ndarray


class _Gltf:
    """A file whose JSON has been read."""

    def __init__(self, file: Path, tree: dict[str, Any], binary: bytes):
        self.file, self.tree = file, tree
        if (version := str(tree.get("asset", {}).get("version", "2.0"))).startswith("1"):
            raise DataError(f"expected glTF 2.0, got {version} in {file}; export it again.")
        if beyond := sorted(set(tree.get("extensionsRequired", [])) - DRAWN):
            raise self._needs(beyond[0])
        self.buffers = [
            self._data(buffer["uri"], "data") if i or "uri" in buffer else binary
            for i, buffer in enumerate(tree.get("buffers", []))
        ]
        self.pictures: dict[int, np.ndarray] = {}

    def parts(self) -> list[Part]:
        for material in self.tree.get("materials", []):  # a texture is at fault also where nothing is covered with it
            if (info := _base(material)[1]) is not None:
                self._texture(info["index"])
        placed = self._placed()
        found = []
        for node, matrix in placed.values():
            if "mesh" in node:
                mesh, instances = self.tree["meshes"][node["mesh"]], matrix @ self._instances(node)
                skin = self._skin(node["skin"], placed) if "skin" in node else None
                weights = node.get("weights", mesh.get("weights", []))
                found += [self._part(each, weights, instances, skin) for each in mesh["primitives"]]
        return [part for part in found if part is not None]

    def _needs(self, extension: str) -> DataError:
        return DataError(f"expected a plain glTF, got one that needs {extension} in {self.file}; export it without.")

    # Nodes

    def _placed(self) -> dict[int, _PlacedNode]:
        """Nodes of the scene by their number."""
        nodes, scenes = self.tree.get("nodes", []), self.tree.get("scenes")
        below = {child for node in nodes for child in node.get("children", [])}
        roots = scenes[self.tree.get("scene", 0)].get("nodes", []) if scenes else sorted(set(range(len(nodes))) - below)
        found: dict[int, _PlacedNode] = {}
        todo = [(root, np.eye(4)) for root in roots]
        while todo:
            index, above = todo.pop()
            if index in found:
                raise DataError(
                    f"expected each node once in a glTF's scene, got node {index} twice in {self.file}; export it "
                    "again."
                )
            node = nodes[index]
            if not node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True):
                continue
            matrix = np.reshape(node.get("matrix", np.eye(4)), (4, 4)).T @ _matrices(
                *(np.array([node.get(name, default)], float) for name, default in _AT_REST.items())
            )
            found[index] = _PlacedNode(node, above @ matrix[0])
            todo += [(child, found[index].matrix) for child in node.get("children", [])]
        return found

    def _instances(self, node: dict[str, Any]) -> np.ndarray:
        """``(I, 4, 4)`` in the node's own space (EXT_mesh_gpu_instancing)."""
        given = node.get("extensions", {}).get("EXT_mesh_gpu_instancing", {}).get("attributes", {})
        values = {name: self._accessor(given[name.upper()]) for name in _AT_REST if name.upper() in given}
        number = min((len(value) for value in values.values()), default=1)
        return _matrices(
            *(values.get(name, np.tile(default, (number, 1)))[:number] for name, default in _AT_REST.items())
        )

    def _skin(self, index: int, placed: dict[int, _PlacedNode]) -> np.ndarray:
        """``(J, 4, 4)`` from a skin's bind pose to the scene."""
        skin = self.tree["skins"][index]
        joints = np.stack([placed[joint].matrix for joint in skin["joints"]])
        if "inverseBindMatrices" in skin:
            joints = joints @ self._accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        return joints

    # Primitives

    def _part(self, primitive, weights, instances: np.ndarray, skin: np.ndarray | None) -> Part | None:
        """All instances of a primitive as one; None where it has no triangles."""
        if primitive.get("mode", _TRIANGLES) < _TRIANGLES:
            return None
        positions = self._attribute(primitive, "POSITION", weights)
        triangles = self._triangles(primitive, len(positions))
        if len(triangles) == 0:
            return None
        if skin is not None and "JOINTS_0" in primitive["attributes"]:
            positions, instances = self._skinned(primitive, positions, skin), np.eye(4)[None]
        if len(instances) > 1:
            check_number(self.file, len(instances) * len(triangles))
        positions = positions @ instances[:, :3, :3].swapaxes(1, 2) + instances[:, None, :3, 3]  # (I, V, 3)
        number, V = positions.shape[:2]
        check_geometry(self.file, positions.reshape(-1, 3), triangles)
        colour, tinted, uv, texture = self._base_colours(primitive, weights, triangles)
        triangles = np.tile(triangles, (number, 1, 1)) + V * np.arange(number)[:, None, None]
        colour, uv = np.tile(colour, (number, 1, 1)), None if uv is None else np.tile(uv, (number, 1, 1, 1))
        mirrored = np.linalg.det(instances[:, :3, :3]) < 0
        triangles[mirrored] = triangles[mirrored, :, ::-1]
        if uv is not None:
            uv[mirrored] = uv[mirrored, :, ::-1]
            uv = uv.reshape(-1, 3, 2)
        return Part(positions.reshape(-1, 3), triangles.reshape(-1, 3), colour.reshape(-1, 3), tinted, uv, texture)

    def _triangles(self, primitive, vertices: int) -> np.ndarray:
        corners = np.arange(vertices)
        if "indices" in primitive:
            corners = self._accessor(primitive["indices"])[:, 0].astype(np.int64)
        mode = primitive.get("mode", _TRIANGLES)
        if mode == _TRIANGLES:
            return corners.reshape(-1, 3)
        i = np.arange(max(len(corners) - 2, 0))
        if mode == _STRIP:
            return corners[np.stack([i, i + 1 + i % 2, i + 2 - i % 2], 1)]
        if mode == _FAN:
            return corners[np.stack([i + 1, i + 2, np.zeros_like(i)], 1)]
        raise ValueError(f"no mode {mode}")

    def _skinned(self, primitive, positions: np.ndarray, skin: np.ndarray) -> np.ndarray:
        """Positions in the scene: of each vertex by the weighted mean of its joints' matrices."""
        sets = [name for name in primitive["attributes"] if name.startswith("JOINTS_")]
        joints = np.concatenate([self._accessor(primitive["attributes"][name]) for name in sets], 1).astype(int)
        names = [name.replace("JOINTS", "WEIGHTS") for name in sets]
        weights = np.concatenate([self._accessor(primitive["attributes"][name]) for name in names], 1).astype(float)
        weights /= np.maximum(weights.sum(1, keepdims=True), 1e-9)
        matrices = np.einsum("vj,vjab->vab", weights, skin[joints])
        return np.einsum("vab,vb->va", matrices[:, :3, :3], positions) + matrices[:, :3, 3]

    def _attribute(self, primitive, name: str, weights) -> np.ndarray:
        """Values ``(V, k)`` of an attribute, its morph targets added."""
        index = primitive["attributes"][name]
        if not {"bufferView", "sparse"} & set(self.tree["accessors"][index]) and primitive.get("extensions"):
            raise self._needs(next(iter(primitive["extensions"])))  # such as Draco's, which has the data
        values = self._accessor(index).astype(float)
        for target, weight in zip(primitive.get("targets", []), weights, strict=False):
            if name in target and weight:
                values = values + weight * self._accessor(target[name])
        return values

    # Materials

    def _base_colours(self, primitive, weights, triangles: np.ndarray):
        """Colour ``(F, 3)`` of 255, tint, uv ``(F, 3, 2)`` and texture of a primitive."""
        material = self.tree["materials"][primitive["material"]] if "material" in primitive else None
        factor, info = _base(material or {})
        colour = _srgb(np.broadcast_to(np.asarray(factor[:3], float), (len(triangles), 3)))
        if "COLOR_0" in primitive["attributes"]:
            own = self._attribute(primitive, "COLOR_0", weights)[:, :3]
            kind = np.dtype(_NUMBERS[self.tree["accessors"][primitive["attributes"]["COLOR_0"]]["componentType"]])
            if kind.kind != "f" and own.max(initial=0) > 1:
                own = own / np.iinfo(kind).max
            own = own[triangles].mean(1)
            # Linear light, but for files that trimesh wrote.
            written_by = str(self.tree.get("asset", {}).get("generator", ""))
            colour = colour * own if "trimesh" in written_by else _srgb(np.asarray(factor[:3]) * own)
        elif material is None:
            colour = np.full((len(triangles), 3), _GREY / 255)
        tinted = is_tinted(str((material or {}).get("name", "")))
        if info is None:
            return 255 * colour, tinted, None, None
        texture, wraps = self._texture(info["index"])
        transform = info.get("extensions", {}).get("KHR_texture_transform", {})
        coordinates = f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}"
        if coordinates not in primitive["attributes"]:
            return 255 * colour, tinted, None, None
        uv = self._attribute(primitive, coordinates, weights)[triangles]
        uv = uv * transform.get("scale", (1.0, 1.0))
        sin, cos = (f(transform.get("rotation", 0.0)) for f in (math.sin, math.cos))
        # v points down, so that anticlockwise is from v to u. The extension's own text had it wrong until
        # https://github.com/KhronosGroup/glTF/issues/1563.
        uv = uv @ np.array([[cos, -sin], [sin, cos]]) + transform.get("offset", (0.0, 0.0))
        return 255 * colour, tinted, *_wrapped(uv, texture, wraps)

    def _texture(self, index: int) -> tuple[np.ndarray, tuple[int, int]]:
        """A texture's pixels, and how it goes on beyond its borders across and down."""
        texture = self.tree["textures"][index]
        extensions = texture.get("extensions", {})
        source = texture.get("source", extensions.get("EXT_texture_webp", {}).get("source"))
        if source is None:
            actual = " and ".join(extensions) or "another format"
            raise DataError(f"expected textures as PNG or JPEG, got {actual} in {self.file}; export it again.")
        if source not in self.pictures:
            image = self.tree["images"][source]
            if "bufferView" in image:
                data = self._view(image["bufferView"])
            else:
                data = self._data(image["uri"], "texture")
            uri = image.get("uri", "data:")
            name = f"the picture inside {self.file}" if uri.startswith("data:") else str(self._path(uri))
            self.pictures[source] = decoded(self.file, name, opened(self.file, name, io.BytesIO(data)))
        sampler = self.tree["samplers"][texture["sampler"]] if "sampler" in texture else {}
        return self.pictures[source], (sampler.get("wrapS", 0), sampler.get("wrapT", 0))

    # Data

    def _accessor(self, index: int) -> np.ndarray:
        """``(count, k)``; numbers that the file calls normalised as such, in 0..1 or -1..1."""
        accessor = self.tree["accessors"][index]
        dtype, count = np.dtype(_NUMBERS[accessor["componentType"]]), accessor["count"]
        width = _WIDTHS[accessor["type"]]
        values = np.zeros((count, width), dtype)
        if "bufferView" in accessor:
            values = self._rows(accessor, count, dtype, width)
        if sparse := accessor.get("sparse"):
            at = self._rows(sparse["indices"], sparse["count"], np.dtype(_NUMBERS[sparse["indices"]["componentType"]]))
            values[at[:, 0]] = self._rows(sparse["values"], sparse["count"], dtype, width)
        return (
            np.maximum(values / np.iinfo(dtype).max, -1.0)
            if accessor.get("normalized") and dtype.kind != "f"
            else values
        )

    def _rows(self, place: dict[str, Any], count: int, dtype: np.dtype, width: int = 1) -> np.ndarray:
        view = place["bufferView"]
        strides = (self.tree["bufferViews"][view].get("byteStride", width * dtype.itemsize), dtype.itemsize)
        return np.ndarray((count, width), dtype, self._view(view), place.get("byteOffset", 0), strides).copy()

    def _view(self, index: int) -> bytes:
        view = self.tree["bufferViews"][index]
        start = view.get("byteOffset", 0)
        return self.buffers[view["buffer"]][start : start + view["byteLength"]]

    def _data(self, uri: str, what: str) -> bytes:
        """What a URI holds, or the file that it names."""
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            return base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)
        try:
            return self._path(uri).read_bytes()
        except OSError:
            raise DataError(
                f"expected the {what} {unquote(uri)} of {self.file} beside it, got no such file; put it there."
            ) from None

    def _path(self, uri: str) -> Path:
        return self.file.parent / unquote(uri)


def _matrices(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """``(I, 4, 4)`` that scale, turn by a quaternion (x, y, z, w), and move."""
    x, y, z, w = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrices = np.tile(np.eye(4), (len(translation), 1, 1))
    matrices[:, :3, :3] = np.moveaxis(np.array(turn), 2, 0) * scale[:, None, :]
    matrices[:, :3, 3] = translation
    return matrices


def _base(material: dict[str, Any]) -> tuple[Any, dict[str, Any] | None]:
    """The base colour's factor and texture."""
    gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if gloss is not None:
        return gloss.get("diffuseFactor", (1.0, 1.0, 1.0)), gloss.get("diffuseTexture")
    rough = material.get("pbrMetallicRoughness", {})
    return rough.get("baseColorFactor", (1.0, 1.0, 1.0)), rough.get("baseColorTexture")


def _wrapped(uv: np.ndarray, texture: np.ndarray, wraps: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The same look from a texture that repeats: one that is mirrored is joined to its mirror image, one that is
    clamped is continued by its border, to its own size on each side."""
    for axis, wrap in enumerate(wraps):  # u is across the image, v down
        low, high, along = uv[..., axis].min(), uv[..., axis].max(), 1 - axis
        if low >= 0 and high <= 1:
            continue
        size = texture.shape[along]
        if wrap == _MIRROR:
            texture = np.concatenate([texture, np.flip(texture, along)], along)
            uv[..., axis] /= 2
        elif wrap == _CLAMP:
            before, after = (int(np.clip(np.ceil(beyond * size), 0, size)) for beyond in (-low, high - 1))
            pads = [(0, 0)] * 3
            pads[along] = (before, after)
            texture = np.pad(texture, pads, mode="edge")
            uv[..., axis] = (np.clip(uv[..., axis], -1, 2) * size + before) / (size + before + after)
    return uv, texture


def _srgb(linear: np.ndarray) -> np.ndarray:
    """Of linear light, both in 0..1."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
