"""Scenes that one can turn: read back by Rerun's own reader and by trimesh."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from probscene.app.chunks import chunk_randomness
from probscene.app.fitting.run import RunFolder
from probscene.app.loading import load_model, renderer_for
from probscene.app.views.scene_parts import camera_matrix, intrinsics, pieces
from probscene.sampling import sample

LOTS = Path(__file__).parents[1] / "lots.py"


@pytest.fixture(scope="module")
def lots():
    return load_model(str(LOTS))


def scenes_of(model, num, seed):
    with chunk_randomness(seed, 0):
        return sample(model, model.prior, num)


def entities(file: Path) -> set[str]:
    """The paths that a recording holds, by Rerun's command line."""
    subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", file], check=True, capture_output=True)
    text = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", file], check=True, capture_output=True, text=True
    )
    return {line.split(" - ")[1] for line in text.stdout.splitlines() if line.startswith("Chunk(")}


def test_a_recording_of_a_3d_scene_holds_all_of_it(tmp_path, call, lots):
    done = call("view", LOTS, "--out", tmp_path / "scene.rrd", "--num", 2, "--seed", 3)
    assert done.code == 0, done.err
    found = entities(tmp_path / "scene.rrd")
    world = scenes_of(lots, 2, 3).drawing
    nodes = {
        f"/world/objects/{lots.grammar.kinds[k]}/{m}/0"
        for row in world.kind.tolist()
        for m, k in enumerate(row)
        if k >= 0
    }
    assert nodes <= found
    camera = {f"/world/camera{path}" for path in ("", "/image", "/image/colour", "/image/classes", "/image/depth")}
    assert camera | {"/graph", "/world/boxes", "/world/objects/ground/1/0"} <= found


def test_a_recording_of_a_2d_scene_holds_image_masks_and_boxes(tmp_path, call, discs):
    assert call("view", discs.file, "--out", tmp_path / "scene.rrd").code == 0
    assert {"/image/colour", "/image/classes", "/image/boxes", "/graph"} <= entities(tmp_path / "scene.rrd")


def test_a_gltf_file_holds_every_object_where_it_stands(tmp_path, call, lots):
    done = call("view", LOTS, "--out", tmp_path / "scene.glb", "--seed", 5)
    assert done.code == 0, done.err
    world = scenes_of(lots, 1, 5).drawing
    whole = trimesh.load_scene(tmp_path / "scene.glb")
    back = np.linalg.inv(np.array([[0.0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]))
    for m, k in enumerate(world.kind[0].tolist()):
        if k < 0:
            continue
        matrix, geometry = whole.graph[f"{lots.grammar.kinds[k]} {m}"]
        shape = whole.geometry[geometry]
        corners = trimesh.transform_points(shape.vertices, back @ matrix)
        layer = next(layer for layer in world.layers if layer.present[0, m])
        mesh = layer.meshes[int(layer.mesh[0, m])]
        c, s = torch.cos(layer.yaw[0, m]).item(), torch.sin(layer.yaw[0, m]).item()
        x, y = mesh.positions[:, 0], mesh.positions[:, 1]
        expected = np.c_[
            c * x - s * y + layer.x[0, m].item(),
            s * x + c * y + layer.y[0, m].item(),
            mesh.positions[:, 2] + layer.z[0, m].item(),
        ]
        assert np.allclose(np.unique(corners.round(3), axis=0), np.unique(expected.round(3), axis=0), atol=2e-3)
        shown = np.unique(np.asarray(shape.visual.vertex_attributes["color"])[:, :3], axis=0)
        srgb = mesh.colour / 255 * np.where(mesh.tinted[:, None], layer.tint[0, m].numpy(), 1.0)
        linear = np.unique(np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4), axis=0)
        assert np.allclose(shown[np.lexsort(shown.T)], 255 * linear[np.lexsort(linear.T)], atol=0.51)
        assert (shape.visual.material.baseColorTexture is None) == (mesh.texture is None)
    ground = [n for n in whole.graph.nodes_geometry if n.startswith("ground")]
    assert len(ground) == 3 and whole.has_camera


def test_what_is_projected_from_pieces_is_what_is_rendered(lots):
    """The amodal box of every box and lid, from corners that OpenCV projects."""
    world = scenes_of(lots, 12, 1).drawing
    turned = {name: 0.3 * torch.rand(12) - 0.15 for name in ("yaw", "pitch", "roll", "x", "y")}
    world = replace(world, camera=replace(world.camera, **turned))
    batch = renderer_for(lots)(world)
    for scene in range(12):
        to_camera = np.linalg.inv(camera_matrix(world, scene))
        corners: dict[str, list] = {}
        for piece in pieces(world, scene):
            corners.setdefault(piece.name, []).append(
                trimesh.transform_points(piece.positions, to_camera @ piece.matrix)
            )
        rotation, shift = cv2.Rodrigues(np.eye(3))[0], np.zeros(3)
        for m, k in enumerate(world.kind[scene].tolist()):
            if k < 0:
                continue
            points = np.concatenate(corners[f"{lots.grammar.kinds[k]} {m}"]).astype(np.float64)
            if points[:, 2].min() < 0.5:
                continue
            seen = cv2.projectPoints(points, rotation, shift, intrinsics(world, scene), None)[0][:, 0] + 0.5
            box = np.r_[seen.min(0), seen.max(0)]
            assert np.allclose(batch.amodal_box[scene, m].numpy(), box, atol=0.05), (scene, m)


def test_views_that_cannot_be(tmp_path, call, discs):
    for words, message in (
        (("--out", tmp_path / "scene.ply"), "suffix .rrd or .glb"),
        (("--out", tmp_path / "new" / "scene.glb"), "a model in 3D"),
        (("--out", tmp_path / "scene.glb", "--num", 2), "one in a .glb, got 2"),
        (("--out", tmp_path / "scene.rrd", "--num", 0), "positive number of scenes"),
    ):
        done = call("view", discs.file, *words)
        assert done.code == 2 and message in done.err and not list(tmp_path.iterdir())


def test_without_rerun_the_message_says_how_to_get_it(tmp_path, call, discs, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = call("view", discs.file, "--out", tmp_path / "new" / "scene.rrd")
    assert done.code == 1 and "pip install 'probscene[view]'" in done.err and not list(tmp_path.iterdir())


def test_a_folder_is_made(tmp_path, call, lots):
    for name in ("scene.glb", "scene.rrd"):
        done = call("view", LOTS, "--out", tmp_path / name.partition(".")[2] / "new" / name)
        assert done.code == 0 and (tmp_path / name.partition(".")[2] / "new" / name).is_file(), done.err


def test_a_fit_that_is_not_finished_cannot_be_seen(tmp_path, call):
    RunFolder.create(tmp_path / "run", str(LOTS), {"guide": {"hidden": 8}})
    done = call("view", tmp_path / "run", "--out", tmp_path / "scene.rrd")
    assert done.code == 2 and "expected a finished fit" in done.err and not (tmp_path / "scene.rrd").exists()
