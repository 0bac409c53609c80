"""glTF: one mesh however a file says it; what cannot be drawn is named."""

import copy
import io
import json
import math
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from probscene.errors import DataError
from probscene.models.assets.meshes.folder import folder
from probscene.models.assets.meshes.reader import read

BOX = trimesh.creation.box((1.8, 1.5, 4.4))
CORNERS = np.float32(BOX.vertices[BOX.faces].reshape(-1, 3) + [0, 0.75, 0])
COORDINATES = np.tile(np.float32([[0.125, 0.125], [0.375, 0.125], [0.375, 0.375]]), (len(BOX.faces), 1))  # red
QUARTERS = np.zeros((64, 64, 3), np.uint8)
QUARTERS[:32, :32], QUARTERS[:32, 32:], QUARTERS[32:, :32], QUARTERS[32:, 32:] = (
    RED, GREEN, BLUE, WHITE,
) = (220, 20, 20), (20, 200, 20), (20, 20, 220), (230, 230, 230)  # fmt: skip
GREY = (200, 200, 200)
NUMBERS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}


def png(pixels, kind="PNG"):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **({"lossless": True} if kind == "WEBP" else {}))
    return file.getvalue()


class File:
    """A box of 4.4 m that is red by its texture, to be changed and written."""

    def __init__(self, corners=CORNERS, coordinates=COORDINATES):
        self.data = b""
        self.tree = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "nodes": [{"mesh": 0}],
                     "scenes": [{"nodes": [0]}], "scene": 0}  # fmt: skip
        attributes = {"POSITION": self.accessor(corners), "TEXCOORD_0": self.accessor(coordinates)}
        self.primitive = {"attributes": attributes, "material": 0}
        self.attributes, self.texture_info = attributes, {"index": 0}
        self.tree |= {
            "meshes": [{"primitives": [self.primitive]}],
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": self.texture_info}}],
            "textures": [{"source": 0}],
            "images": [{"bufferView": self.view(png(QUARTERS)), "mimeType": "image/png"}],
        }

    def view(self, data, **more):
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more},
        )
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, values, normalized=False, **more):
        """Rows are padded to four bytes, as the specification asks."""
        values = np.ascontiguousarray(values)
        flat = values.reshape(len(values), -1)
        row = flat.shape[1] * flat.itemsize
        stride = row + -row % 4 if flat.shape[1] > 1 else row
        rows = np.zeros((len(flat), stride), np.uint8)
        rows[:, :row] = flat.view(np.uint8).reshape(len(flat), row)
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[flat.shape[1]]
        view = self.view(rows.tobytes(), **({"byteStride": stride} if stride != row else {}))
        self.tree["accessors"].append(
            {"bufferView": view, "componentType": NUMBERS[values.dtype.name], "count": len(values), "type": kind,
             **({"normalized": True} if normalized else {}), **more}
        )  # fmt: skip
        return len(self.tree["accessors"]) - 1

    def extension(self, owner, name, value, required=True):
        owner.setdefault("extensions", {})[name] = value
        if required:
            self.tree.setdefault("extensionsRequired", []).append(name)

    def bytes(self):
        tree = json.dumps(self.tree | {"buffers": [{"byteLength": len(self.data)}]}).encode()
        tree, data = tree + b" " * (-len(tree) % 4), self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<I", len(tree)) + b"JSON" + tree + struct.pack("<I", len(data)) + b"BIN\0" + data
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks

    def read(self, path):
        (path / "a.glb").write_bytes(self.bytes())
        return read(path / "a.glb")


def corners_of(fields):
    """``(F, 3, 3)`` in the axes of the file: x left, y up, z forward."""
    return fields["positions"][fields["triangles"]][..., [1, 2, 0]]


def middles(fields):
    """``(F, 3)`` the colour in the middle of each face."""
    colour = fields["colour"].astype(float)
    if fields["texture"] is None:
        return colour
    height, width = fields["texture"].shape[:2]
    u, v = np.moveaxis(fields["uv"].mean(1), 1, 0)
    return (
        colour
        / 255
        * fields["texture"][np.floor(v * height).astype(int) % height, np.floor(u * width).astype(int) % width]
    )


def second_coordinates(file):
    file.attributes |= {"TEXCOORD_1": file.attributes["TEXCOORD_0"], "TEXCOORD_0": file.accessor(COORDINATES + 0.5)}
    file.texture_info["texCoord"] = 1


def coordinates_by_the_transform(file):
    second_coordinates(file)
    file.extension(file.texture_info, "KHR_texture_transform", {"texCoord": 1})
    file.texture_info["texCoord"] = 0


def texture_transform(file):
    file.attributes["TEXCOORD_0"] = file.accessor(np.float32((COORDINATES - [0.5, 0.25]) / [2, -0.5]))
    file.extension(file.texture_info, "KHR_texture_transform", {"offset": [0.5, 0.25], "scale": [2, -0.5]})


def coordinates_normalised(dtype):
    def change(file):
        values = np.rint(COORDINATES * np.iinfo(dtype).max).astype(dtype)
        file.attributes["TEXCOORD_0"] = file.accessor(values, normalized=True)
        file.tree["extensionsUsed"] = ["KHR_mesh_quantization"]

    return change


def coordinates_whole(file):
    file.attributes["TEXCOORD_0"] = file.accessor((COORDINATES * 1024).astype(np.int16))
    file.extension(file.texture_info, "KHR_texture_transform", {"scale": [1 / 1024, 1 / 1024]})
    file.tree["extensionsRequired"].append("KHR_mesh_quantization")


def positions_normalised(dtype):
    def change(file):
        values = np.rint((CORNERS - [0, 0.75, 0]) / 2.2 * np.iinfo(dtype).max).astype(dtype)
        file.attributes["POSITION"] = file.accessor(values, normalized=True)
        file.tree["nodes"][0] |= {"scale": [2.2] * 3, "translation": [0, 0.75, 0]}
        file.tree["extensionsRequired"] = ["KHR_mesh_quantization"]

    return change


def sparse(file, base=True):
    wrong = CORNERS.copy()
    wrong[:] = 0 if not base else wrong
    at = np.arange(len(CORNERS)) if not base else np.array([3, 7])
    wrong[at] = 0 if not base else [9, 9, 9]
    number = file.accessor(wrong)
    file.attributes["POSITION"] = number
    accessor = file.tree["accessors"][number]
    accessor["sparse"] = {
        "count": len(at),
        "indices": {"bufferView": file.view(at.astype(np.uint16).tobytes()), "componentType": 5123},
        "values": {"bufferView": file.view(CORNERS[at].tobytes())},
    }
    if not base:
        del accessor["bufferView"]


def morphed(owner, name="POSITION"):
    def change(file):
        values = {"POSITION": CORNERS, "TEXCOORD_0": COORDINATES}[name]
        by = np.float32(np.random.default_rng(0).normal(size=(2, *values.shape)))
        file.attributes[name] = file.accessor(np.float32(values - 0.5 * by[0] + 0.25 * by[1]))
        file.primitive["targets"] = [{name: file.accessor(target)} for target in by]
        file.tree["meshes"][0]["weights"] = [0.5, -0.25]
        if owner == "nodes":
            file.tree["meshes"][0]["weights"], file.tree["nodes"][0]["weights"] = [9, 9], [0.5, -0.25]

    return change


def indexed(dtype):
    def change(file):
        order = np.random.default_rng(1).permutation(len(CORNERS))
        for name, values in (("POSITION", CORNERS), ("TEXCOORD_0", COORDINATES)):
            file.attributes[name] = file.accessor(values[order])
        file.primitive["indices"] = file.accessor(np.argsort(order).astype(dtype))

    return change


def as_fans(file):
    """One of every triangle."""
    whole = np.arange(len(CORNERS), dtype=np.uint8).reshape(-1, 3)
    file.tree["meshes"][0]["primitives"] = [
        {**file.primitive, "mode": 6, "indices": file.accessor(np.roll(face, 1))} for face in whole
    ]


def as_strip(file):
    """Joined by triangles without an area; every second one is where a strip turns over."""
    strip = []
    for i in range(0, len(CORNERS), 3):
        strip += [i, i, i, i + 1, i + 2, i + 2] if i % 2 else [i, i, i + 2, i + 1, i + 1, i + 1]
    file.primitive |= {"mode": 5, "indices": file.accessor(np.array(strip, np.uint16))}


def instance(file):
    file.attributes["POSITION"] = file.accessor(np.float32(CORNERS[:, [2, 1, 0]] * [-0.5, 0.5, 0.5] - [0, 0, 1]))
    turned = np.array([[0, math.sin(math.pi / 4), 0, math.cos(math.pi / 4)]])  # z to x
    given = {"ROTATION": np.rint(turned * 32767).astype(np.int16), "SCALE": np.float32([[2, 2, 2]])}
    given["TRANSLATION"] = np.float32([[2, 0, 0]])
    numbers = {name: file.accessor(value, normalized=name == "ROTATION") for name, value in given.items()}
    file.extension(file.tree["nodes"][0], "EXT_mesh_gpu_instancing", {"attributes": numbers})


def skinned(file):
    """Halves of the box hang on two joints that have moved since they were bound; the node's own place is ignored."""
    front = (CORNERS[:, 2] > 0).astype(int)
    file.attributes["POSITION"] = file.accessor(np.float32(CORNERS * 10 - np.array([[0, 0, 3], [1, 2, 0]])[front]))
    file.attributes["JOINTS_0"] = file.accessor(np.stack([front, *[0 * front] * 3], 1).astype(np.uint8))
    weights = np.tile(np.uint8([255, 0, 0, 0]), (len(CORNERS), 1))
    file.attributes["WEIGHTS_0"] = file.accessor(weights, normalized=True)
    bind = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    bind[:, :3, 3] = [[0, 0, 3], [1, 2, 0]]
    file.tree["skins"] = [{"joints": [2, 3], "inverseBindMatrices": file.accessor(bind.swapaxes(1, 2).copy())}]
    file.tree["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [7, 7, 7]},
        {"children": [2, 3], "scale": [0.1] * 3},
        {},
        {"name": "head"},
    ]
    file.tree["scenes"][0]["nodes"] = [0, 1]


def lines_beside(file):
    number = file.accessor(np.float32([[0, 0, 0], [0, 0, 9]]))
    others = [{"attributes": {"POSITION": number}, "mode": mode} for mode in (0, 1, 2, 3)]
    file.tree["meshes"][0]["primitives"] += others
    file.tree["meshes"].append({"primitives": others})
    file.tree["nodes"].append({"mesh": 1})
    file.tree["scenes"][0]["nodes"].append(1)


def webp(file):
    file.tree["images"].append({"bufferView": file.view(png(QUARTERS, "WEBP")), "mimeType": "image/webp"})
    file.tree["textures"] = [{}]
    file.extension(file.tree["textures"][0], "EXT_texture_webp", {"source": 1})


def specular_glossiness(file):
    rough = file.tree["materials"][0].pop("pbrMetallicRoughness")
    value = {"diffuseTexture": rough["baseColorTexture"], "specularFactor": [0, 0, 0]}
    file.extension(file.tree["materials"][0], "KHR_materials_pbrSpecularGlossiness", value)


def mirrored(file):
    """What the data mirrors, faces and all, one of two nodes mirrors back."""
    mirror = CORNERS.reshape(-1, 3, 3)[:, ::-1, ::-1].reshape(-1, 3)
    file.attributes["POSITION"] = file.accessor(mirror)
    matrix = [[0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
    columns = np.transpose(matrix).reshape(-1).tolist()
    file.tree["nodes"] = [{"children": [1], "scale": [-1, 1, 1]}, {"mesh": 0, "matrix": columns}]


def mirrored_texture(file):
    file.attributes["TEXCOORD_0"] = file.accessor(np.float32(COORDINATES * [-1, 1] + [2, -2]))
    file.tree |= {"samplers": [{"wrapS": 33648, "wrapT": 33648}]}
    file.tree["textures"][0]["sampler"] = 0


def clamped_texture(file):
    file.attributes["TEXCOORD_0"] = file.accessor(np.float32(COORDINATES - [1.0, 0.5]))
    file.tree |= {"samplers": [{"wrapS": 33071, "wrapT": 33071}]}
    file.tree["textures"][0]["sampler"] = 0


def hidden(file):
    file.tree["nodes"] += [{"children": [2]}, {"mesh": 0, "translation": [0, 0, 9]}]
    file.tree["scenes"][0]["nodes"].append(1)
    file.extension(file.tree["nodes"][1], "KHR_node_visibility", {"visible": False})


def another_scene(file):
    file.tree["nodes"].append({"mesh": 0, "translation": [0, 0, 9]})
    file.tree["scenes"].insert(0, {"nodes": [1]})
    file.tree["scene"] = 1


ENCODINGS = {
    "as it is": lambda file: None,
    "TEXCOORD_1": second_coordinates,
    "the transform's texCoord": coordinates_by_the_transform,
    "texture transform": texture_transform,
    "uint8 coordinates": coordinates_normalised(np.uint8),
    "uint16 coordinates": coordinates_normalised(np.uint16),
    "coordinates of whole numbers": coordinates_whole,
    "int8 positions": positions_normalised(np.int8),
    "int16 positions": positions_normalised(np.int16),
    "sparse": sparse,
    "sparse on nothing": lambda file: sparse(file, base=False),
    "morph weights of the mesh": morphed("meshes"),
    "morph weights of the node": morphed("nodes"),
    "morphed coordinates": morphed("meshes", "TEXCOORD_0"),
    "uint8 indices": indexed(np.uint8),
    "uint16 indices": indexed(np.uint16),
    "uint32 indices": indexed(np.uint32),
    "fans": as_fans,
    "a strip": as_strip,
    "an instance": instance,
    "a skin": skinned,
    "lines and points beside": lines_beside,
    "WebP": webp,
    "specular and glossiness": specular_glossiness,
    "mirrored": mirrored,
    "a mirrored texture": mirrored_texture,
    "a clamped texture": clamped_texture,
    "a hidden node": hidden,
    "the second scene": another_scene,
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_one_mesh_however_it_is_encoded(tmp_path, encoding):
    """The same triangles in the same place, all of them red, and turned as a plain box that stands beside."""
    file = File()
    plain = {"primitives": [{"attributes": {"POSITION": file.attributes["POSITION"]}}]}
    ENCODINGS[encoding](file)
    file.tree["meshes"].append(plain)
    file.tree["nodes"].append({"mesh": len(file.tree["meshes"]) - 1, "translation": [50, 0, 0]})
    file.tree["scenes"][file.tree["scene"]]["nodes"].append(len(file.tree["nodes"]) - 1)
    fields = file.read(tmp_path)
    found, colour = corners_of(fields), middles(fields)
    step = 2.2 / 127 / 2 if encoding == "int8 positions" else 3e-4
    for here, move, expected in ((found[:, 0, 0] < 25, 0, RED), (found[:, 0, 0] > 25, 50, GREY)):
        got, wanted = found[here] - [move, 0, 0], CORNERS.reshape(-1, 3, 3)
        assert len(got) == len(wanted) and (colour[here] == expected).all()
        got, wanted = (c[np.lexsort(np.round(c.mean(1), 1).T)] for c in (got, wanted))
        for one, other in zip(got, wanted, strict=True):
            assert min(np.abs(np.roll(one, k, 0) - other).max() for k in range(3)) <= step


@given(
    st.tuples(*[st.floats(-2, 2)] * 2), st.floats(-4, 4), st.tuples(*[st.floats(-3, 3)] * 2), st.booleans()
)  # fmt: skip
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_texture_transform_scales_then_turns_then_moves(tmp_path, offset, rotation, scale, beside):
    """In the plane of u to the right and -v up, in which the turn is anticlockwise."""
    file = File()
    file.extension(
        file.texture_info, "KHR_texture_transform", {"offset": offset, "rotation": rotation, "scale": scale}, beside
    )
    u, v = (COORDINATES.astype(float) * scale).T
    turned = (u - 1j * v) * np.exp(1j * rotation) + complex(offset[0], -offset[1])
    expected = np.stack([turned.real, -turned.imag], 1).reshape(-1, 3, 2)
    uv = file.read(tmp_path)["uv"]
    assert uv is not None and np.abs(uv - expected).max() < 1e-5


places = st.fixed_dictionaries(
    {},
    optional={
        "translation": st.lists(st.floats(-3, 3), min_size=3, max_size=3),
        "rotation": st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1),
        "scale": st.lists(st.sampled_from([-2.0, -1.0, 0.5, 1.0, 3.0]), min_size=3, max_size=3),
    },
)


@given(st.lists(places, min_size=1, max_size=4), st.booleans())
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_nodes_are_where_trimesh_has_them(tmp_path, chain, by_matrix):
    """A chain of nodes, with the mesh in the last and in the middle one; a mesh that is turned over is turned back."""
    file = File()
    for node in chain:
        if "rotation" in node:
            node["rotation"] = (np.array(node["rotation"]) / np.linalg.norm(node["rotation"])).tolist()
    file.tree["nodes"] = [{**node, "children": [i + 1]} for i, node in enumerate(chain)] + [{"mesh": 0}]
    file.tree["nodes"][len(chain) // 2]["mesh"] = 0
    if by_matrix:
        matrix = np.eye(4) + np.triu(np.ones((4, 4)), 1)
        file.tree["nodes"][0] = {k: v for k, v in file.tree["nodes"][0].items() if k in ("mesh", "children")}
        file.tree["nodes"][0]["matrix"] = matrix.T.reshape(-1).tolist()
    fields = file.read(tmp_path)
    expected = trimesh.load_scene(tmp_path / "a.glb", process=False).to_mesh().triangles
    found = corners_of(fields)
    extent = np.ptp(expected.reshape(-1, 3), axis=0).max()
    assert len(found) == len(expected)
    for c in (found.mean(1), expected.mean(1)):
        c[:] = c[np.lexsort(np.round(c / extent, 3).T)]
    assert np.abs(np.sort(found.reshape(-1, 3), 0) - np.sort(expected.reshape(-1, 3), 0)).max() < 1e-5 * extent
    assert trimesh.Trimesh(found.reshape(-1, 3), np.arange(found.size // 3).reshape(-1, 3)).volume > 0


@given(st.integers(0, 2**32), st.integers(1, 5))
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_instances_are_copies(tmp_path, seed, number):
    """Under their node; a mirrored copy is no more inside out than the others."""
    rng = np.random.default_rng(seed)
    move, turn = rng.normal(size=(number, 3)), rng.normal(size=(number, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    scale = rng.choice([-1.0, 0.5, 2.0], (number, 3))
    file = File()
    numbers = {
        name: file.accessor(np.float32(value))
        for name, value in (("TRANSLATION", move), ("ROTATION", turn), ("SCALE", scale))
    }
    file.extension(file.tree["nodes"][0], "EXT_mesh_gpu_instancing", {"attributes": numbers})
    file.tree["nodes"][0]["translation"] = [1, 2, 3]
    found = corners_of(file.read(tmp_path))
    expected = []
    for t, q, s in zip(move, turn, scale, strict=True):
        matrix = trimesh.transformations.quaternion_matrix(q[[3, 0, 1, 2]])[:3, :3] * s
        expected.append(CORNERS @ matrix.T + t + [1, 2, 3])
    expected = np.concatenate(expected)
    assert np.abs(np.sort(found.reshape(-1, 3), 0) - np.sort(expected, 0)).max() < 1e-4
    volume = sum(np.abs(np.prod(s)) * BOX.volume for s in scale)
    a, b, c = np.moveaxis(found, 1, 0)
    assert np.einsum("fi,fi->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=1e-3)


def linear(colour):
    """sRGB of 255 to linear light of 1 (IEC 61966-2-1)."""
    c = np.asarray(colour, float) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8, np.uint16])
@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("factor", [None, (180, 90, 200)])
def test_colours_of_vertices_are_linear_light_times_the_factor(tmp_path, dtype, alpha, factor):
    colour = (200, 120, 250)
    own = np.tile(np.append(linear(colour), [0.5] * alpha), (len(CORNERS), 1))
    file = File()
    normalised = dtype is not np.float32
    own = np.rint(own * np.iinfo(dtype).max).astype(dtype) if normalised else np.float32(own)
    file.attributes["COLOR_0"] = file.accessor(own, normalized=normalised)
    factors = {} if factor is None else {"baseColorFactor": [*linear(factor), 1.0]}
    file.tree["materials"][0] = {"pbrMetallicRoughness": factors}
    if factor is None:
        del file.primitive["material"]
    expected = linear(colour) * (1 if factor is None else linear(factor))
    found = file.read(tmp_path)["colour"]
    assert np.abs(linear(found) - expected).max() < (0.01 if dtype is not np.uint8 else 0.02)


def test_a_factor_that_is_dark_keeps_its_hue(tmp_path):
    file = File()
    file.tree["materials"][0] = {"pbrMetallicRoughness": {"baseColorFactor": [*linear((12, 6, 3)), 1.0]}}
    assert (file.read(tmp_path)["colour"] == (12, 6, 3)).all()
    file.tree["materials"][0] = {}
    file.extension(
        file.tree["materials"][0],
        "KHR_materials_pbrSpecularGlossiness",
        {"diffuseFactor": [*linear((200, 10, 30)), 1.0]},
    )
    assert (file.read(tmp_path)["colour"] == (200, 10, 30)).all()


def test_a_grey_picture_of_16_bits(tmp_path):
    file = File()
    values = np.uint16(QUARTERS[..., 0]) * 257
    file.tree["images"] = [{"bufferView": file.view(png(values)), "mimeType": "image/png"}]
    assert (middles(file.read(tmp_path)) == RED[0]).all()


@pytest.mark.parametrize(
    "name",
    ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu", "MSFT_lod", "KHR_techniques_webgl"],
)
def test_an_extension_that_is_needed_and_not_drawn_is_named(tmp_path, name):
    file = File()
    file.tree["extensionsRequired"] = ["KHR_texture_transform", name]
    with pytest.raises(DataError, match=rf"a plain glTF, got one that needs {name} in .*a\.glb; export it without"):
        file.read(tmp_path)
    file.tree["extensionsRequired"], file.tree["extensionsUsed"] = [], [name]
    assert (middles(file.read(tmp_path)) == RED).all()


def test_data_that_only_an_extension_has_is_named(tmp_path):
    file = File()
    for number in file.attributes.values():
        del file.tree["accessors"][number]["bufferView"]
    file.extension(file.primitive, "KHR_draco_mesh_compression", {"bufferView": 0}, required=False)
    with pytest.raises(DataError, match="needs KHR_draco_mesh_compression"):
        file.read(tmp_path)
    file = File()
    file.tree["textures"] = [{}]
    file.extension(file.tree["textures"][0], "KHR_texture_basisu", {"source": 0}, required=False)
    with pytest.raises(DataError, match=r"PNG or JPEG, got KHR_texture_basisu in .*a\.glb"):
        file.read(tmp_path)


def test_too_many_instances_are_counted_before_they_are_made(tmp_path):
    file = File()
    move = file.accessor(np.zeros((20_000, 3), np.float32))
    file.extension(file.tree["nodes"][0], "EXT_mesh_gpu_instancing", {"attributes": {"TRANSLATION": move}})
    with pytest.raises(DataError, match=r"at most 200000 triangles, got 240000 in .*a\.glb"):
        file.read(tmp_path)


def test_nodes_in_a_circle(tmp_path):
    file = File()
    file.tree["nodes"][0]["children"] = [0]
    with pytest.raises(DataError, match=r"each node once .* node 0 twice in .*a\.glb"):
        file.read(tmp_path)


def leaves(value, path=()):
    """Where every value of a JSON tree is."""
    yield from [path] if path else []
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield from leaves(value[key], (*path, key))


@given(st.data())
@settings(deadline=None, max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_file_is_read_or_named(tmp_path, data):
    file = File()
    data.draw(st.sampled_from([second_coordinates, texture_transform, sparse, morphed("nodes"), instance, skinned]))(
        file
    )
    file.tree = copy.deepcopy(file.tree)
    *path, key = data.draw(st.sampled_from(sorted(leaves(file.tree), key=repr)))
    owner = file.tree
    for step in path:
        owner = owner[step]
    if data.draw(st.booleans()):
        owner.pop(key)
    else:
        owner[key] = data.draw(st.sampled_from([None, -1, 0, 1, 77, 0.5, 1e30, "x", [], {}, [0], True]))
    try:
        fields = file.read(tmp_path)
    except DataError as error:
        assert "a.glb" in str(error) and "; " in str(error)
    else:
        assert np.isfinite(fields["positions"]).all() and fields["triangles"].max() < len(fields["positions"])


def test_lines_beside_faces_in_an_obj(tmp_path):
    faces = "v 0 0 -2\nv 1 0 -2\nv 1 1 2\nv 0 1 2\nf 1 2 3 4\n"
    (tmp_path / "car").mkdir()
    (tmp_path / "car" / "a.obj").write_text(faces + "l 1 3\np 2\n")
    (tmp_path / "car" / "b.obj").write_text(faces)
    a, b = folder(tmp_path)["car"]
    assert np.array_equal(a.positions[a.triangles], b.positions[b.triangles])
