"""Meshes of one's own: what is read is what was written, in our pose; every fault is named with its file."""

import base64
import io
import json
import logging
import math
import re
import shutil
import struct
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from probscene.errors import DataError
from probscene.models.assets.meshes.folder import SIZES, described, folder
from probscene.models.assets.meshes.part import decoded, opened
from probscene.models.assets.things.catalogue import DECORATION, KINDS, street

TO_Y_UP = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # x forward, y left, z up to z forward, x left, y up
CAR = (4.4, 1.8, 1.5)
CAR_OBJ = "".join(
    f"v {x} {y} {z}\n" for x in (-0.9, 0.9) for y in (0, 1.5) for z in (-2.2, 2.2)
) + "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"  # fmt: skip


def write(tmp_path, kind, name, data):
    path = tmp_path / kind / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def linear(colour):
    """sRGB of 255 to linear light of 1, as the sRGB standard (IEC 61966-2-1) has it."""
    c = np.asarray(colour, float) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def as_trimesh(mesh, up):
    """Corners of their own for every face; colours of vertices, or the mesh's texture."""
    corners = (mesh.positions[mesh.triangles].reshape(-1, 3).astype(float)) @ up.T
    faces = np.arange(len(corners)).reshape(-1, 3)
    if mesh.texture is None:
        colours = np.repeat(np.c_[mesh.colour, np.full(len(mesh.colour), 255, np.uint8)], 3, 0)
        return trimesh.Trimesh(corners, faces, vertex_colors=colours, process=False)
    uv = mesh.uv.reshape(-1, 2) * [1, -1] + [0, 1]
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(mesh.texture), name="picture")
    return trimesh.Trimesh(corners, faces, visual=trimesh.visual.TextureVisuals(uv, material=material), process=False)


def colour_at_middles(mesh):
    """``(F, 3)`` the colour in the middle of each face, by the nearest texel."""
    colour = mesh.colour.astype(float)
    if mesh.texture is None:
        return colour
    height, width = mesh.texture.shape[:2]
    u, v = np.moveaxis(mesh.uv.mean(1), 1, 0)
    return (
        colour * mesh.texture[np.floor(v * height).astype(int) % height, np.floor(u * width).astype(int) % width] / 255
    )


@pytest.mark.parametrize("suffix", ["obj", "glb", "gltf", "ply"])
@pytest.mark.parametrize("kind", ["car", "truck", "pedestrian", "pole", "object"])
def test_what_trimesh_writes_comes_back(tmp_path, kind, suffix):
    """The same triangles, turned the same way, with the same colours."""
    own = street()[kind][0]
    written = as_trimesh(own, np.eye(3) if suffix == "ply" else TO_Y_UP)
    (tmp_path / kind).mkdir()
    if suffix == "gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(written)).items():
            write(tmp_path, kind, name, data)
    else:
        written.export(tmp_path / kind / f"a.{suffix}")
    (back,) = folder(tmp_path)[kind]
    assert np.abs(own.positions[own.triangles] - back.positions[back.triangles]).max() < 1e-4
    assert (own.colour == back.colour).all() and not back.tinted.any()
    assert back.positions[:, 2].min() == 0


@pytest.mark.parametrize("kind", ["building", "sign"])
def test_textures_come_back(tmp_path, kind):
    own = street()[kind][0]
    (tmp_path / kind).mkdir()
    as_trimesh(own, TO_Y_UP).export(tmp_path / kind / "a.glb")
    (back,) = folder(tmp_path)[kind]
    assert (back.texture == own.texture).all() and (back.colour == 255).all()
    assert np.abs(own.positions[own.triangles] - back.positions[back.triangles]).max() < 1e-4
    assert np.abs(back.uv - own.uv).max() < 1e-4


def test_a_texture_is_read_whatever_is_wrong_with_a_comment(tmp_path):
    texture = io.BytesIO()
    Image.new("RGB", (4, 4), (200, 0, 0)).save(texture, "PNG")
    data = texture.getvalue()
    data = data[:33] + b"\0\0\0\4tEXta\0bc\1\2\3\4" + data[33:]
    file = write(tmp_path, "car", "a.png", data)
    for source in (str(file), io.BytesIO(data)):
        assert (decoded(file, "a.png", opened(file, "a.png", source)) == (200, 0, 0)).all()


def test_kinds_that_are_lacking_are_the_projects_own(tmp_path):
    write(tmp_path, "car", "a.obj", CAR_OBJ)
    found = folder(str(tmp_path))
    assert set(found) == set(street()) == {*KINDS, *DECORATION} == set(SIZES)
    assert all(found[kind] is street()[kind] for kind in found if kind != "car")
    (car,) = found["car"]
    assert car.size.tolist() == pytest.approx(CAR) and len(car.triangles) == 12


def test_many_files_come_in_the_order_of_their_names(tmp_path):
    for name in ("b@4m.obj", "a@5x1.9x1.6m.obj", "c.obj"):
        write(tmp_path, "car", name, CAR_OBJ)
    a, b, c = folder(tmp_path)["car"]
    assert a.size.tolist() == pytest.approx([5, 1.9, 1.6]) and c.size.tolist() == pytest.approx(CAR)
    assert b.size.tolist() == pytest.approx(np.multiply(CAR, 4 / 4.4).tolist())
    a, b, c = np.moveaxis(a.positions[a.triangles], 1, 0)
    across = np.cross(b - a, c - a)
    assert np.allclose(np.abs(across / np.linalg.norm(across, axis=1, keepdims=True)).max(1), 1)


def test_an_obj_faces_z(tmp_path):
    """Its lamp is at +z, its left is +x, its up is +y."""
    lamp = "v -0.5 0.5 2.2\nv -0.4 0.5 2.2\nv -0.5 0.6 2.3\nf 9 10 11\n"
    write(tmp_path, "car", "a.obj", CAR_OBJ + lamp)
    (car,) = folder(tmp_path)["car"]
    middle = car.positions[car.triangles[-1]].mean(0)
    assert middle[0] > 2.1 and middle[1] < -0.4 and 0.5 < middle[2] < 0.6


def test_geometry_is_where_the_scene_puts_it(tmp_path):
    """Two wheels of one geometry, one mirrored; what is inside out is turned."""
    body = trimesh.creation.box((1.8, 1.5, 4.4))
    wheel = trimesh.creation.cylinder(0.3, 0.2, sections=8)
    scene = trimesh.Scene()
    scene.add_geometry(body, transform=trimesh.transformations.translation_matrix([0, 1.0, 0]))
    turned = trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0])
    move = trimesh.transformations.translation_matrix([0.9, 0.3, 1.4])
    scene.add_geometry(wheel, geom_name="wheel", node_name="left", transform=move @ turned)
    scene.graph.update("right", matrix=np.diag([-1.0, 1, 1, 1]) @ move @ turned, geometry="wheel")
    (tmp_path / "car").mkdir()
    scene.export(tmp_path / "car" / "a.glb")
    body.invert()
    trimesh.Scene(body).export(tmp_path / "car" / "b.glb")
    car, inverted = folder(tmp_path)["car"]
    assert len(car.triangles) == len(body.faces) + 2 * len(wheel.faces)
    assert car.size.tolist() == pytest.approx([4.4, 2.0, 1.75], abs=1e-3)
    expected = 1.8 * 1.5 * 4.4 + 2 * wheel.volume
    for mesh, volume in ((car, expected), (inverted, 1.8 * 1.5 * 4.4)):
        a, b, c = np.moveaxis(mesh.positions[mesh.triangles].astype(float), 1, 0)
        assert np.einsum("fi,fi->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=1e-3)
    assert np.abs(car.positions[car.positions[:, 2] < 0.2][:, 1]).min() > 0.7  # wheels on both sides


def test_colours_of_materials_and_what_is_painted(tmp_path):
    """An MTL's colours are sRGB, glTF's factors are linear light; "paint" in a name takes the tint."""
    write(
        tmp_path,
        "car",
        "a.obj",
        "mtllib a.mtl\n" + CAR_OBJ.replace("f 5", "usemtl CarPaint\nf 5").replace("f 1 2", "usemtl b\nf 1 2"),
    )
    write(tmp_path, "car", "a.mtl", "newmtl b\nKd 0.2 0.4 0.6\nnewmtl CarPaint\nKd 0.8 0.1 0.0\n")
    material = trimesh.visual.material.PBRMaterial(name="b", baseColorFactor=[*linear([51, 102, 153]), 1.0])
    box = trimesh.creation.box((1.8, 1.5, 4.4))
    box.visual = trimesh.visual.TextureVisuals(material=material)
    box.export(tmp_path / "car" / "b.glb")
    a, b = folder(tmp_path)["car"]
    assert sorted(map(tuple, np.unique(a.colour, axis=0).tolist())) == [(51, 102, 153), (204, 26, 0)]
    assert (a.tinted == (a.colour[:, 0] == 204)).all() and 0 < a.tinted.sum() < 12
    assert np.abs(b.colour.astype(int) - [51, 102, 153]).max() <= 3 and not b.tinted.any()  # trimesh keeps 8 bits of it


def test_several_materials_are_baked_into_one_texture(tmp_path):
    """Two pictures, one of which repeats, and a plain colour: every face looks as before."""
    rng = np.random.default_rng(3)
    square = np.array([(0.2 * x, 0.3 + 0.2 * y, 0) for y in range(5) for x in range(5)])
    faces = np.array([(i, i + 1, i + 6) for y in range(4) for i in range(5 * y, 5 * y + 4)])
    scene, expected = trimesh.Scene(), []
    for k, (h, w, low, high) in enumerate([(16, 32, 0.02, 0.98), (64, 16, -1.01, 2.03)]):
        picture = rng.integers(0, 256, (h, w, 3), np.uint8)
        uv = low + (high - low) * (square[:, :2] - [0, 0.3]) / 0.8
        material = trimesh.visual.material.SimpleMaterial(name=f"m{k}", image=Image.fromarray(picture))
        visual = trimesh.visual.TextureVisuals(uv, material=material)
        scene.add_geometry(trimesh.Trimesh(square + [0, 0, 1.5 * k], faces, visual=visual, process=False))
        u, v = np.moveaxis(uv[faces].mean(1), 1, 0)
        expected += [*picture[np.floor((1 - v) * h).astype(int) % h, np.floor(u * w).astype(int) % w]]
    material = trimesh.visual.material.SimpleMaterial(name="m2", diffuse=(40, 80, 120, 255))
    visual = trimesh.visual.TextureVisuals(material=material)
    scene.add_geometry(trimesh.Trimesh(square + [0, 0, 3], faces, visual=visual, process=False))
    expected += [(40, 80, 120)] * len(faces)
    (tmp_path / "car").mkdir()
    scene.export(tmp_path / "car" / "a.obj")
    (mesh,) = folder(tmp_path)["car"]
    assert mesh.texture is not None and (mesh.uv >= 0).all() and (mesh.uv <= 1).all()
    middles = mesh.positions[mesh.triangles].mean(1)
    order = np.lexsort(np.round(middles, 2).T[[1, 2, 0]])
    assert np.abs(colour_at_middles(mesh)[order] - np.array(expected)).max() <= 1


def test_a_picture_that_repeats_often_becomes_its_mean(tmp_path):
    texture = np.zeros((8, 8, 3), np.uint8)
    texture[:4] = (200, 100, 40)
    box = trimesh.creation.box((1.8, 1.5, 4.4))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(texture))
    box.visual = trimesh.visual.TextureVisuals(box.vertices[:, :2] * 50, material=material)
    (tmp_path / "car").mkdir()
    box.export(tmp_path / "car" / "a.glb")
    (mesh,) = folder(tmp_path)["car"]
    assert mesh.texture is None and (mesh.colour == (100, 50, 20)).all()


def test_smooth_where_round_and_sharp_at_edges(tmp_path):
    (tmp_path / "object").mkdir()
    trimesh.creation.icosphere(2, 0.5).export(tmp_path / "object" / "ball.glb")
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "object" / "box.glb")
    ball, box = folder(tmp_path)["object"]
    outward = ball.positions[ball.triangles] - [0, 0, 0.5]
    assert np.einsum("fci,fci->fc", ball.normals, outward / 0.5).min() > 0.99
    assert np.allclose(np.abs(box.normals).max(-1), 1)


def picture_of_half_its_bytes():
    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)).save(file, "PNG")
    return file.getvalue()[: file.tell() // 2]


def gltf(**change):
    """A triangle of 4.4 m by 1.8 m with the data inside."""
    data = np.array([[-0.9, 0, 0], [0.9, 0, 0], [0, 1.5, 4.4]], np.float32).tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}], "scene": 0, "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"byteLength": 36, "uri": INSIDE + base64.b64encode(data).decode()}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3",
                       "min": [-0.9, 0, 0], "max": [0.9, 1.5, 4.4]}],
    }  # fmt: skip
    return json.dumps(tree | change)


INSIDE = "data:application/octet-stream;base64,"
MATERIAL = [{"name": "m", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
PICTURE = {"materials": MATERIAL, "textures": [{"source": 0}], "images": [{"uri": "a%20b.png"}]}
TEXTURED = "mtllib a.mtl\nvt 0 0\nusemtl m\n" + CAR_OBJ.replace("f 1 2 4 3", "f 1/1 2/1 4/1 3/1")
FACES = CAR_OBJ.index("f")
ALL_TEXTURED = "mtllib a.mtl\nvt 0 0\nusemtl m\n" + CAR_OBJ[:FACES] + re.sub(r"(\d)", r"\1/1", CAR_OBJ[FACES:])
HUGE = CAR_OBJ.replace("2.2", "220").replace("0.9", "90").replace("1.5", "150")
BROKEN = picture_of_half_its_bytes()
DENTED = "v -0.9 0 -2.2\nv 0.9 0 -2.2\nv -0.5 0 0\nv 0.9 0 2.2\nv -0.9 0 2.2\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
    "property list uchar int vertex_indices\nend_header\n-2.2 -0.9 0\n-2.2 0.9 0\n0 -0.5 0\n2.2 0.9 0\n2.2 -0.9 0\n"
)
FAULTS = {
    "no triangle": ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 0 4\n", "got"),
    "an empty file": ("a.obj", "", "got"),
    "an empty glb": ("a.glb", "", "expected a glTF file"),
    "no glb": ("a.glb", "hello there, this is no glTF file", "expected a glTF file"),
    "an empty ply": ("a.ply", "", "expected a mesh"),
    "a cut stl": ("a.stl", "\0" * 90, "expected a mesh"),
    "no area": ("a.obj", "v 0 0 0\nv 0 0 2\nv 0 0 4\nf 1 2 3\n", "with an area"),
    "NaN": ("a.obj", CAR_OBJ.replace("v -0.9 0 -2.2", "v nan 0 -2.2"), "finite vertices"),
    "infinity": ("a.obj", CAR_OBJ.replace("v -0.9 0 -2.2", "v inf 0 -2.2"), "finite vertices"),
    "a vertex that is not there": ("a.obj", CAR_OBJ + "f 1 2 99\n", "expected"),
    "centimetres": ("a.obj", HUGE, "expected a car 2.2 to 6.5 m long, got 440 m in .*centimetres.*a@3.8m.obj"),
    "a toy": ("a.obj", CAR_OBJ.replace("2.2", "0.022"), "got 0.044 m .*in metres"),
    "sideways": ("a.obj", CAR_OBJ.replace("0.9", "3.9"), "longer than wide, got 4.4 m long and 7.8 m wide"),
    "too high": ("a.obj", CAR_OBJ.replace("1.5", "500"), "at most 200 m, got 500 m"),
    "a named size of none": ("a@0m.obj", CAR_OBJ, "above 0 m"),
    "no materials": ("a.obj", "mtllib gone.mtl\n" + CAR_OBJ, "gone.mtl, got no such file"),
    "no texture": ("a.obj", TEXTURED, "texture my brick.png of .*no such file", "map_Kd -s 1 1 1 my brick.png\n"),
    "a texture's scale of words": (
        "a.obj",
        TEXTURED,
        "numbers after -s and -o of .*got -s on",
        "map_Kd -s on a.png\n",
    ),
    "a texture that is none": ("a.obj", TEXTURED, r"expected a picture, got .*a\.mtl", "map_Kd a.mtl\n"),
    "a broken texture": (
        "a.obj",
        ALL_TEXTURED,
        r"a picture that decodes, got .*a\.png, which .*truncated",
        "map_Kd a.png\n",
    ),
    "a polygon with a dent": ("a.obj", DENTED + "f 1 2 3 4 5\n", "one with a dent in line 6 of"),
    "a dent, counted back": (
        "a.obj",
        DENTED + "f -5/1/1 -4/1/1 -3/1/1 -2/1/1 -1/1/1\n",
        "one with a dent in line 6 of",
    ),
    "a dent in a ply": ("a.ply", PLY.format(1) + "5 0 1 2 3 4\n", "one with a dent, face 0 of"),
    "a dent beside a triangle": ("a.ply", PLY.format(2) + "3 0 1 2\n5 0 1 2 3 4\n", "one with a dent, face 1 of"),
    "another format": ("a.fbx", "", r"as \.glb, .*a\.fbx; export it as \.glb or remove"),
    "a gltf's texture": ("a.gltf", {**PICTURE}, "texture a b.png of .*no such file"),
    "a gltf's data": ("a.gltf", {"buffers": [{"byteLength": 36, "uri": "gone.bin"}]}, "gone.bin .*no such file"),
    "a gltf's order": ("a.gltf", {**PICTURE, "images": []}, "fit together"),
    "a gltf's picture format": ("a.gltf", {**PICTURE, "textures": [{}]}, "PNG or JPEG"),
    "a compressed gltf": ("a.gltf", {"extensionsRequired": ["KHR_draco_mesh_compression"]}, "plain glTF"),
    "lines": ("a.gltf", {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 3}]}]}, "triangles"),
    "points": ("a.gltf", {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}]}, "triangles"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named_with_their_file(tmp_path, fault, caplog):
    name, data, message, *material = FAULTS[fault]
    write(tmp_path, "car", name, gltf(**data) if isinstance(data, dict) else data)
    if material:
        write(tmp_path, "car", "a.mtl", "newmtl m\n" + material[0])
        write(tmp_path, "car", "a.png", BROKEN)
    with caplog.at_level(logging.DEBUG), pytest.raises(DataError, match=message) as caught:
        folder(tmp_path)
    assert name in str(caught.value) and "; " in str(caught.value)
    assert not [record for record in caplog.records if not record.name.startswith("PIL.")]


def area(mesh):
    a, b, c = np.moveaxis(mesh.positions[mesh.triangles].astype(float), 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


@pytest.mark.parametrize("start", range(5))
def test_polygons_are_filled_or_refused(tmp_path, start):
    """Of a polygon with a dent, only the corner in it sees all; whichever comes first, the area is right or nothing."""
    corners = [(start + i) % 5 + 1 for i in range(5)]
    write(tmp_path, "car", "a.obj", DENTED + f"f {' '.join(map(str, corners))}\n")
    try:
        (car,) = folder(tmp_path)["car"]
    except DataError as error:
        assert "a dent" in str(error) and corners[0] != 3
    else:
        assert corners[0] == 3 and area(car) == pytest.approx(1.8 * 4.4 - 1.4 * 4.4 / 2)


@pytest.mark.parametrize(
    "faces", [[(0, 1, 2, 3, 4)], [(0, 1, 2), (0, 2, 3, 4)], [(0, 2, 3, 4), (0, 1, 2), (0, 1, 2, 3, 4)]]
)
def test_a_binary_ply_of_many_corners(tmp_path, faces):
    """One with a dent; and lengths that differ, where the third file is as long as if they did not."""
    header = PLY.partition("-2.2")[0].replace("ascii", "binary_little_endian").format(len(faces)).encode()
    places = struct.pack("<15f", *map(float, PLY.partition("end_header\n")[2].split()))
    lists = b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
    write(tmp_path, "car", "a.ply", header + places + lists)
    with pytest.raises(DataError, match="a dent, face 0|triangulate"):
        folder(tmp_path)


def test_polygons_without_dents_are_filled(tmp_path):
    angle = np.arange(7) * 2 * math.pi / 7
    ring = "".join(f"v {0.9 * math.sin(t):.6f} {math.sin(t):.6f} {2.2 * math.cos(t):.6f}\n" for t in angle)
    write(tmp_path, "car", "a.obj", ring + "f 1 2 3 4 5 6 7\n")
    write(tmp_path, "car", "b.obj", CAR_OBJ)
    seven, cuboid = folder(tmp_path)["car"]
    across = math.hypot(0.9, 1)
    assert area(seven) == pytest.approx(3.5 * math.sin(2 * math.pi / 7) * 2.2 * across, rel=1e-5)
    assert area(cuboid) == pytest.approx(2 * (4.4 * 1.8 + 4.4 * 1.5 + 1.8 * 1.5))


def test_a_folder_is_described_by_all_that_it_holds(tmp_path):
    for name in "ab":
        write(tmp_path / name, "car", "a.obj", CAR_OBJ)
    write(tmp_path / "a", "car", "._a.obj", "left by an archive")
    write(tmp_path / "b", "car", "a.png", "another")
    a, b = (described(tmp_path / name) for name in "ab")
    assert a.startswith(f"meshes in {tmp_path / 'a'} (") and a.split("(")[1] != b.split("(")[1]
    write(tmp_path / "c", "car", "a.obj", CAR_OBJ)
    assert described(tmp_path / "c").split("(")[1] == a.split("(")[1]
    with pytest.raises(DataError, match="expected a folder of meshes"):
        described(tmp_path / "d")


def test_a_gltf_that_is_whole_is_read(tmp_path):
    """The faults above are what they seem."""
    write(tmp_path, "car", "a.gltf", gltf())
    (car,) = folder(tmp_path)["car"]
    assert len(car.triangles) == 1 and car.size.tolist() == pytest.approx([4.4, 1.8, 1.5])


def test_folders_that_cannot_be_used(tmp_path):
    with pytest.raises(DataError, match="expected a folder of meshes, got .*nowhere"):
        folder(tmp_path / "nowhere")
    with pytest.raises(DataError, match="subfolders such as car"):
        folder(tmp_path)
    (tmp_path / "b" / "car").mkdir(parents=True)
    with pytest.raises(DataError, match="mesh files .* in .*car, got none"):
        folder(tmp_path / "b")
    write(tmp_path / "c", "zeppelin", "a.obj", CAR_OBJ)
    with pytest.raises(DataError, match="subfolders among car, van, .*zeppelin"):
        folder(tmp_path / "c")
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "a.obj").write_text(CAR_OBJ)
    with pytest.raises(DataError, match="a subfolder for their kind, got .*a.obj"):
        folder(tmp_path / "d")


def test_trimesh_is_imported_only_to_read_a_mesh():
    program = "import sys, probscene.models.assets.meshes.folder; assert 'trimesh' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_kit_from_outside(tmp_path, data_dir):
    """Its cars face forward (lamps in front are yellow), stand on their wheels, and keep their colours."""
    kit = data_dir / "assets3d" / "glb" / "kenney_car-kit"
    if not kit.is_dir():
        pytest.skip(f"no meshes in {kit}")
    for kind, name, size in (("car", "sedan", "4.4x1.8x1.5"), ("car", "taxi", "4.5"), ("van", "ambulance", "5.6"),
                             ("truck", "firetruck", "8"), ("object", "cone", "0.75")):  # fmt: skip
        (tmp_path / kind).mkdir(exist_ok=True)
        shutil.copy(kit / f"{name}.glb", tmp_path / kind / f"{name}@{size}m.glb")
    found = folder(tmp_path)
    sedan, taxi = found["car"]
    assert sedan.size.tolist() == pytest.approx([4.4, 1.8, 1.5]) and taxi.size[0] == pytest.approx(4.5)
    assert found["object"][0].size[2] == pytest.approx(0.75) and found["truck"][0].size[0] == pytest.approx(8)
    for mesh in (sedan, taxi, *found["van"], *found["truck"]):
        assert 1000 < len(mesh.triangles) < 4000 and mesh.texture is not None
    colour = colour_at_middles(sedan)
    lamps = sedan.positions[sedan.triangles].mean(1)[(colour[:, 0] > 220) & (colour[:, 1] > 160) & (colour[:, 2] < 120)]
    assert len(lamps) and lamps[:, 0].min() > 1.5


@pytest.mark.parametrize(
    ("options", "scale", "offset"),
    [
        ("-s 2 -0.5 1 -o 0.5 0.25 0", (2, -0.5), (0.5, 0.25)),
        ("-clamp off -o 0.5", (1, 1), (0.5, 0)),
        ("-s 0.25 3", (0.25, 3), (0, 0)),
    ],
)
def test_a_texture_of_an_mtl_has_options(tmp_path, options, scale, offset):
    """As if the coordinates had been scaled and moved; v is upward."""
    pixels = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    uv = np.array([(0.2, 0.1), (0.9, 0.3), (0.4, 0.8)])
    corners = "".join(f"v {x} 0 {z}\n" for x, z in ((-0.9, -2.2), (0.9, -2.2), (0, 2.2)))
    for name, option, values in (("a", options, uv), ("b", "", uv * scale + offset)):
        coordinates = "".join(f"vt {u} {v}\n" for u, v in values)
        write(tmp_path, "car", f"{name}.obj", f"mtllib {name}.mtl\n{corners}{coordinates}usemtl m\nf 1/1 2/2 3/3\n")
        write(tmp_path, "car", f"{name}.mtl", f"newmtl m\nmap_Kd {option} my brick.png\n")
    Image.fromarray(pixels).save(tmp_path / "car" / "my brick.png")
    a, b = folder(tmp_path)["car"]
    assert np.allclose(a.uv, b.uv, atol=1e-6) and (a.texture == pixels).all() and (b.texture == pixels).all()
