"""The project's own meshes and surfaces: real sizes, closed, outward, on the ground, seamless, always the same."""

import numpy as np
import pytest

from probscene.models.assets.kerbs import LENGTHS
from probscene.models.assets.surfaces import ASPHALTS, DASH, MARKING, PITCH, surfaces
from probscene.models.assets.things.catalogue import DECORATION, GROUPS, KINDS, street

# Length, width and height in metres, and triangles: the least and the most.
EXPECTED = {
    "car": ((3.3, 5.2), (1.6, 2.1), (1.35, 1.85), (150, 500)),
    "van": ((4.2, 6.4), (1.8, 2.3), (1.7, 2.7), (150, 500)),
    "truck": ((5.5, 14.0), (2.1, 3.0), (2.3, 4.0), (150, 600)),
    "building": ((6.0, 20.0), (5.0, 26.0), (5.5, 25.0), (20, 200)),
    "tree": ((2.0, 10.0), (2.0, 10.0), (4.5, 14.0), (150, 400)),
    "bush": ((0.6, 2.5), (0.5, 4.2), (0.4, 2.0), (60, 300)),
    "pole": ((0.2, 4.5), (0.2, 2.0), (3.2, 8.5), (40, 250)),
    "sign": ((0.05, 0.2), (0.6, 3.0), (2.2, 4.2), (30, 100)),
    "pedestrian": ((0.25, 1.6), (0.35, 0.9), (1.1, 1.95), (150, 320)),
    "cyclist": ((1.6, 2.0), (0.5, 0.8), (1.5, 1.95), (400, 620)),
    "object": ((0.15, 1.9), (0.15, 1.8), (0.7, 3.5), (20, 320)),
    "slab": ((8.0, 128.0), (1.0, 1.0), (1.0, 1.0), (12, 12)),
    "kerb": ((8.0, 128.0), (0.1, 0.2), (0.1, 0.15), (12, 12)),
    "lawn": ((8.0, 128.0), (1.0, 1.0), (1.0, 1.0), (12, 12)),
    "fence": ((5.9, 6.1), (0.03, 0.4), (0.6, 1.4), (12, 330)),
}
VEHICLES = ("car", "van", "truck")
MESHES = [(kind, k) for kind, meshes in street().items() for k in range(len(meshes))]


@pytest.fixture(params=MESHES, ids=lambda which: f"{which[0]}-{which[1]}")
def kind_and_mesh(request):
    kind, k = request.param
    return kind, street()[kind][k]


def welded(mesh):
    """Triangles over vertices that are one where they are at the same place."""
    _, same = np.unique(mesh.positions, axis=0, return_inverse=True)
    return same.reshape(-1)[mesh.triangles]


def pieces(triangles):
    """Which connected piece each triangle belongs to."""
    label = np.arange(triangles.max() + 1)
    while True:
        least = label[triangles].min(1)
        after = label.copy()
        np.minimum.at(after, triangles.reshape(-1), np.repeat(least, 3))
        if (after == label).all():
            return label[triangles[:, 0]]
        label = after


def test_every_kind_is_there():
    assert tuple(street()) == KINDS + DECORATION and set(street()) == set(EXPECTED)
    assert len(street()["car"]) >= 6 and len(street()["building"]) >= 12 and len(street()["tree"]) >= 8


def test_groups_share_out_all_meshes_of_their_kind():
    for kind, groups in GROUPS.items():
        assert sorted(k for group in groups.values() for k in group) == list(range(len(street()[kind])))


def test_sizes_are_real_and_triangles_few(kind_and_mesh):
    kind, mesh = kind_and_mesh
    *sizes, (least, most) = EXPECTED[kind]
    for actual, (low, high) in zip(mesh.size, sizes, strict=True):
        assert low - 1e-4 <= actual <= high + 1e-4, mesh.size
    assert least <= len(mesh.triangles) <= most


def test_meshes_stand_on_the_ground_in_the_middle(kind_and_mesh):
    _, mesh = kind_and_mesh
    low, high = mesh.positions.min(0), mesh.positions.max(0)
    assert low[2] == 0 and np.abs(low[:2] + high[:2]).max() < 1e-4


def test_surfaces_are_closed_and_face_outward(kind_and_mesh):
    """Every edge is run along as often one way as the other, and every connected piece has something inside."""
    _, mesh = kind_and_mesh
    triangles = welded(mesh)
    n = triangles.max() + 1
    sides = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]).astype(np.int64)
    sides = sides[sides[:, 0] != sides[:, 1]]
    assert (np.sort(sides @ [n, 1]) == np.sort(sides @ [1, n])).all()
    corners = mesh.positions[mesh.triangles].astype(float)
    label = pieces(triangles)
    for piece in np.unique(label):
        a, b, c = np.moveaxis(corners[label == piece] - corners[label == piece].mean((0, 1)), 1, 0)
        assert np.einsum("fi,fi->", a, np.cross(b, c)) > 0


def test_corner_normals_agree_with_their_faces(kind_and_mesh):
    _, mesh = kind_and_mesh
    a, b, c = np.moveaxis(mesh.positions[mesh.triangles].astype(float), 1, 0)
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    assert np.allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-5)
    assert np.einsum("fci,fi->fc", mesh.normals, across).min() > 0.1


def test_textures_come_with_coordinates(kind_and_mesh):
    kind, mesh = kind_and_mesh
    assert (mesh.uv is None) == (mesh.texture is None)
    if kind in ("building", "tree", "bush", "sign", "slab", "kerb", "lawn"):
        assert mesh.texture is not None and np.ptp(mesh.uv.reshape(-1, 2), axis=0).min() > 0.1


def test_vehicles_are_painted_and_their_tyres_glass_and_lamps_are_not():
    for kind in VEHICLES:
        for mesh in street()[kind]:
            paint, bare = mesh.colour[mesh.tinted], mesh.colour[~mesh.tinted]
            assert mesh.tinted.mean() > 0.1 and paint.min() > 200
            assert ((bare.max(1) < 60).mean() > 0.2) and (bare[:, 0].astype(int) - bare[:, 1] > 90).any()


def test_windows_are_higher_than_doors_and_wheels_are_below():
    """A car's glass lies in its upper half, over most of its length; its tyres reach the ground."""
    for kind in ("car", "van"):
        for mesh in street()[kind]:
            glass = mesh.positions[mesh.triangles[(mesh.colour == (34, 40, 46)).all(1)]]
            tyres = mesh.positions[mesh.triangles[(mesh.colour == (26, 26, 28)).all(1)]]
            assert glass[..., 2].min() > 0.5 * mesh.size[2] and tyres[..., 2].min() == 0
            assert tyres[..., 2].max() < 0.5 * mesh.size[2] and np.abs(tyres[..., 1]).max() < mesh.size[1] / 2
            assert {(x, y) for x, y, _ in glass.reshape(-1, 3)} == {(x, -y) for x, y, _ in glass.reshape(-1, 3)}


def test_lamps_look_forward_and_tail_lamps_back():
    for kind in VEHICLES:
        for mesh in street()[kind]:
            middle = mesh.positions[mesh.triangles].mean(1)[:, 0]
            red = (mesh.colour == (158, 20, 22)).all(1)
            white = (mesh.colour == (240, 240, 228)).all(1)
            assert middle[red].max() < -0.4 * mesh.size[0] and middle[white].min() > 0.35 * mesh.size[0]


def test_signs_show_their_picture_to_the_front():
    for mesh in street()["sign"]:
        corners = mesh.positions[mesh.triangles]
        a, b, c = np.moveaxis(corners, 1, 0)
        pictured = (mesh.uv[..., 1] < 0.5).any(1)
        assert pictured.any() and (np.cross(b - a, c - a)[pictured, 0] > 0).all()
        left_to_right, top_to_bottom = mesh.uv[pictured].reshape(-1, 2).T
        y, z = corners[pictured].reshape(-1, 3)[:, 1:].T
        assert np.cov(y, left_to_right)[0, 1] > 0 > np.cov(z, top_to_bottom)[0, 1]


def test_a_street_of_thirty_things_has_about_14_000_triangles():
    mean = {kind: np.mean([len(mesh.triangles) for mesh in meshes]) for kind, meshes in street().items()}
    numbers = {"car": 10, "van": 1, "truck": 1, "building": 5, "tree": 5, "bush": 2, "pole": 2}
    numbers |= {"sign": 1, "pedestrian": 2, "cyclist": 1}
    assert sum(numbers.values()) == 30
    assert 8_000 < sum(mean[kind] * number for kind, number in numbers.items()) < 14_000


def test_every_call_makes_the_same_bytes():
    before = street()
    np.random.seed(7)
    after = street.__wrapped__()
    for kind, meshes in before.items():
        for one, other in zip(meshes, after[kind], strict=True):
            for name, value in vars(one).items():
                same = value is None or (value == getattr(other, name)).all()
                assert same, (kind, name)
    for name, surface in surfaces.__wrapped__().items():
        assert (surface.texture == surfaces()[name].texture).all()


def steps(texture, axis):
    """Mean difference from each line of texels to the next, the last to the first included, which comes last."""
    lines = np.moveaxis(texture.astype(float), axis, 0)
    return np.abs(np.roll(lines, -1, 0) - lines).mean((1, 2))


@pytest.mark.parametrize("name", surfaces())
def test_grounds_have_no_seams(name):
    for axis in (0, 1):
        *inside, seam = steps(surfaces()[name].texture, axis)
        assert seam <= max(inside) * 1.02


def test_textures_of_meshes_have_no_seams_where_they_repeat():
    for kind, axes in (("building", (1,)), ("tree", (0, 1)), ("bush", (0, 1)), ("slab", (0, 1)), ("kerb", (0, 1))):
        for mesh in street()[kind]:
            for axis in axes:
                *inside, seam = steps(mesh.texture, axis)
                assert seam <= max(inside) * 1.02


def test_surfaces_have_the_classes_of_a_street():
    found = surfaces()
    assert {surface.name for surface in found.values()} == {"road", "sidewalk", "terrain"}
    for name in ASPHALTS:
        assert all(found[f"{name}{line}"].name == "road" for line in ("", "_dashed", "_solid", "_edge", "_yellow"))
    for surface in found.values():
        height, width = surface.texture.shape[:2]
        assert height & (height - 1) == 0 and width & (width - 1) == 0


@pytest.mark.parametrize("name", ASPHALTS)
def test_dashes_are_3_m_long_every_9_m_on_the_same_asphalt(name):
    dashed, road = surfaces()[f"{name}_dashed"], surfaces()[name]
    bright = dashed.texture.mean((1, 2)) > 170
    runs = np.flatnonzero(np.diff(bright.astype(int), prepend=bright[-1]))
    assert len(runs) == 2 and dashed.tile[0] == PITCH == 9.0 and DASH == 3.0
    assert bright.sum() / len(bright) * PITCH == pytest.approx(DASH, abs=0.05) and 0.12 <= MARKING <= 0.15
    assert np.abs(dashed.texture[~bright].mean((0, 1)) - road.texture.mean((0, 1))).max() < 4
    assert (surfaces()[f"{name}_solid"].texture.mean((1, 2)) > 170).all()


def test_slabs_come_in_lengths_with_as_many_stones_a_metre():
    for kind in ("slab", "kerb", "lawn"):
        for mesh, length in zip(street()[kind], LENGTHS, strict=True):
            assert mesh.size[0] == pytest.approx(length)
            assert np.ptp(mesh.uv[..., 0]) / length == pytest.approx(np.ptp(street()[kind][0].uv[..., 0]) / LENGTHS[0])
