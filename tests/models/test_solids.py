"""Closed solids: volumes by formula, faces outward, what moving and stretching keeps."""

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from probscene.models.assets import solids
from probscene.models.assets.solids import (
    ball,
    box,
    circle,
    corner_normals,
    finish,
    hoop,
    join,
    lathe,
    loft,
    mapped,
    place,
    prism,
    stretch,
    tube,
)

sizes = st.floats(0.05, 20.0)
places = st.tuples(*[st.floats(-30, 30)] * 3)
angles = st.floats(-math.pi, math.pi)


def inside(part) -> float:
    """Volume, as the sum over faces of the mean height times the area as seen from above."""
    a, b, c = (part.positions[part.triangles[:, k]] for k in range(3))
    seen = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    return float(((a + b + c)[:, 2] / 3 * seen).sum())


def open_edges(part) -> int:
    """Edges that are not run along as often one way as the other."""
    sides = np.concatenate([part.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    n = len(part.positions)
    return int((np.sort(sides @ [n, 1]) != np.sort(sides @ [1, n])).sum())


@given(st.tuples(sizes, sizes, sizes), places, angles, angles, angles)
def test_a_box_keeps_its_volume_wherever_it_is_put(size, at, roll, pitch, yaw):
    part = place(box(size), at, roll, pitch, yaw)
    assert inside(part) == pytest.approx(np.prod(size), rel=1e-4, abs=1e-4)
    assert open_edges(part) == 0 and len(part.triangles) == 12


@given(st.tuples(*[st.floats(0.2, 3.0)] * 3), st.booleans())
def test_stretching_multiplies_the_volume_and_keeps_faces_outward(by, mirror):
    part = stretch(ball((1, 1, 1), rows=6, sides=9), (by[0] * (-1 if mirror else 1), *by[1:]))
    before = inside(ball((1, 1, 1), rows=6, sides=9))
    assert inside(part) == pytest.approx(before * np.prod(by))
    assert (np.einsum("fci,fci->fc", part.normals, part.positions[part.triangles]) > 0).all()


@given(st.floats(0.1, 4.0), st.integers(3, 24), sizes)
def test_a_lathe_and_a_prism_of_one_circle_are_as_large(radius, sides, height):
    area = sides / 2 * radius**2 * math.sin(2 * math.pi / sides)
    for part in (lathe([(radius, 0), (radius, height)], sides), prism(circle(radius, sides), height)):
        assert inside(part) == pytest.approx(area * height, rel=1e-4) and open_edges(part) == 0


def test_a_cone_has_a_third_of_its_prism():
    part = lathe([(1.0, 0), (0.0, 3.0)], 12)
    assert inside(part) == pytest.approx(12 / 2 * math.sin(math.pi / 6), rel=1e-6) and open_edges(part) == 0


@given(st.lists(st.tuples(*[st.floats(-0.4, 0.4)] * 2), min_size=2, max_size=6), st.integers(3, 8))
def test_tubes_are_closed_and_outward(bends, sides):
    path = [(x, y, float(k)) for k, (x, y) in enumerate(bends)]
    part = tube(path, 0.1, sides)
    assert open_edges(part) == 0 and inside(part) > 0


def test_a_hoop_is_as_large_as_pappus_says():
    part = hoop(1.0, 0.1, 200, (0, 0, 0), around=60)
    assert inside(part) == pytest.approx(2 * math.pi * math.pi * 0.01, rel=0.01) and open_edges(part) == 0


def test_round_things_are_smooth_and_boxes_are_not():
    smooth, sharp = ball((1, 1, 1), rows=12, sides=24), box((1, 1, 1))
    outward = smooth.positions[smooth.triangles]
    assert (np.einsum("fci,fci->fc", smooth.normals, outward) > 0.98).all()
    assert np.allclose(np.abs(sharp.normals).max(-1), 1)


def test_a_whole_is_the_sum_of_its_parts_put_on_the_ground():
    parts = box((1, 2, 3), (5, 5, 5)), place(box((1, 1, 1)), (9, 5, -2))
    assert inside(join(*parts)) == pytest.approx(7)
    mesh = finish(*parts)
    assert mesh.positions[:, 2].min() == 0 and np.allclose(mesh.positions.min(0)[:2], -mesh.positions.max(0)[:2])
    assert mesh.uv is None and mesh.size.tolist() == pytest.approx([5, 2, 10])


def test_colours_go_along_a_loft():
    rings = [[(x, y, z) for x, y in circle(1, 4)] for z in (0.0, 1.0, 2.0)]
    part = loft(rings, np.array([[[10.0] * 3] * 4, [[20.0] * 3] * 4]), ends=(30, 30, 30))
    height = part.positions[part.triangles].mean(1)[:, 2]
    expected = np.where((height < 1e-6) | (height > 2 - 1e-6), 30, np.where(height < 1, 10, 20))
    assert (part.colour[:, 0] == expected).all()


def test_a_texture_lies_in_metres():
    part = mapped(box((4, 6, 2)), (2.0, 0.5))
    up = np.abs(part.normals[..., 2]) > 0.5
    assert np.ptp(part.uv[up][:, 0]) == pytest.approx(2) and np.ptp(part.uv[up][:, 1]) == pytest.approx(12)


def normals_by_definition(positions, triangles, crease):
    """Face by face."""
    a, b, c = np.moveaxis(positions[triangles], 1, 0)
    across = np.cross(b - a, c - a)
    unit = across / np.linalg.norm(across, axis=1, keepdims=True)
    normals = np.empty((len(triangles), 3, 3))
    for f, k in np.ndindex(len(triangles), 3):
        there = (triangles == triangles[f, k]).any(1) & (unit @ unit[f] > math.cos(crease))
        normals[f, k] = across[there].sum(0)
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


@given(st.integers(0, 2**32), st.integers(4, 9), st.integers(1, 60), st.floats(0.1, 1.5))
def test_corner_normals_are_means_of_the_faces_there(seed, vertices, faces, crease):
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(vertices, 3))
    triangles = np.array([rng.permutation(vertices)[:3] for _ in range(faces)])
    whole = corner_normals(positions, triangles, crease)
    assert np.allclose(whole, normals_by_definition(positions, triangles, crease), atol=1e-6)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solids, "_PAIRS", faces)
        assert np.array_equal(corner_normals(positions, triangles, crease), whole)


def fan(faces, height):
    """A cone about z, its triangles from the tip at the origin outward."""
    rim = np.column_stack([circle(1.0, faces), np.full(faces, -height)])
    i = np.arange(faces)
    return np.vstack([[0.0, 0, 0], rim]), np.stack([0 * i, i + 1, (i + 1) % faces + 1], 1)


@pytest.mark.parametrize("height", [0.3, 1.0, 4.0])
def test_a_crowd_of_faces_takes_little_memory(height):
    """Of 3,000 faces at one vertex, all pairs are nine million."""
    tracemalloc.start()
    normals = corner_normals(*fan(3000, height), math.radians(40))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 120e6
    few = corner_normals(*fan(250, height), math.radians(40))
    cosine = np.einsum("fi,fi->f", normals[::12, 0], few[:, 0])
    assert cosine.min() > math.cos(math.radians(3.5))


@pytest.mark.parametrize("copies", [2, 100, 1000])
def test_copies_in_one_place_have_the_normals_of_one(copies):
    part = ball((1.0, 2.0, 0.5))
    triangles = np.tile(part.triangles, (copies, 1))
    normals = corner_normals(part.positions, triangles, solids.ROUND)
    one = corner_normals(part.positions, part.triangles, solids.ROUND)
    assert np.allclose(normals.reshape(copies, -1, 3, 3), one, atol=1e-9)
