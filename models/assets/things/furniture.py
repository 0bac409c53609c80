"""Street furniture, a few of each; benches and letter boxes face +x."""

from probscene.mesh import Mesh

from ..solids import Solid, box, finish, join, lathe, loft, place, tube
from .people import bicycle

STEEL, DARK, CONCRETE, WOOD, GLOW = (150, 154, 156), (58, 62, 62), (172, 170, 164), (130, 104, 78), (238, 236, 222)
ORANGE, PALE, COPPER = (222, 86, 30), (238, 236, 230), (84, 104, 92)


def objects() -> tuple[Mesh, ...]:
    """Litter bin, two wheeled bins, bench, hydrant, traffic cone, parked bicycle, bollard, letter box, cabinet,
    advertising column, barrier."""
    return (
        _litter_bin(),
        finish(_wheeled(0.72, 0.56, 1.06)),
        finish(_wheeled(1.05, 1.30, 1.30)),
        _bench(),
        _hydrant(),
        _cone(),
        finish(bicycle(), box((0.02, 0.12, 0.3), (-0.08, 0.08, 0), STEEL)),
        finish(
            lathe([(0.08, 0), (0.08, 0.8), (0.085, 0.82), (0.085, 0.9), (0, 0.98)], 8, colour=(DARK, GLOW, GLOW, DARK))
        ),
        _letter_box(),
        finish(box((0.42, 1.0, 1.25), colour=(158, 164, 150)), box((0.48, 1.06, 0.06), (0, 0, 1.25), CONCRETE)),
        _column(),
        _barrier(),
    )


def _litter_bin() -> Mesh:
    profile = [(0.20, 0), (0.24, 0.75), (0.26, 0.78), (0.22, 0.9), (0.0, 0.95)]
    return finish(lathe(profile, 8, colour=((74, 92, 78), DARK, DARK, DARK)))


def _bench() -> Mesh:
    seat = [box((0.10, 1.7, 0.05), (x, 0, 0.42), WOOD) for x in (-0.12, 0.02, 0.16)]
    back = [box((0.05, 1.7, 0.10), (-0.26, 0, z), WOOD) for z in (0.58, 0.76)]
    legs = [box((0.45, 0.07, 0.42), (0, y, 0), DARK) for y in (-0.65, 0.65)]
    stays = [box((0.05, 0.07, 0.5), (-0.22, y, 0.4), DARK) for y in (-0.65, 0.65)]
    return finish(*seat, *back, *legs, *stays)


def _hydrant() -> Mesh:
    profile = [(0.17, 0), (0.17, 0.06), (0.12, 0.08), (0.12, 0.55), (0.16, 0.6), (0.1, 0.72), (0, 0.78)]
    spouts = tube([(0, -0.21, 0.44), (0, 0.21, 0.44)], 0.06, 6, (190, 176, 60))
    return finish(lathe(profile, 8, colour=(176, 40, 34)), spouts)


def _cone() -> Mesh:
    profile = [(0.16, 0.04), (0.135, 0.2), (0.11, 0.34), (0.085, 0.48), (0.06, 0.6), (0.035, 0.75)]
    return finish(box((0.42, 0.42, 0.04), colour=DARK), lathe(profile, 8, colour=(ORANGE, PALE, ORANGE, PALE, ORANGE)))


def _letter_box() -> Mesh:
    slot, foot = box((0.02, 0.30, 0.06), (0.18, 0, 1.15), DARK), box((0.10, 0.10, 0.35), colour=DARK)
    return finish(box((0.36, 0.46, 1.0), (0, 0, 0.35), (224, 178, 40)), slot, foot)


def _column() -> Mesh:
    """With four bills on it."""
    profile = [(0.68, 0), (0.68, 0.3), (0.6, 0.32), (0.6, 2.7), (0.72, 2.75), (0.72, 2.9), (0.35, 3.3), (0, 3.4)]
    colours = (CONCRETE, CONCRETE, (186, 180, 160), DARK, COPPER, COPPER, COPPER)
    bills = ((0.2, (176, 70, 60)), (1.5, (70, 110, 150)), (2.9, (206, 176, 80)), (4.4, (90, 130, 90)))
    papers = [
        place(box((0.03, 0.62, 1.0), (0.60, 0, 1.0 + 0.5 * (k % 2)), colour), yaw=angle)
        for k, (angle, colour) in enumerate(bills)
    ]
    return finish(lathe(profile, 12, colour=colours), *papers)


def _barrier() -> Mesh:
    planks = [box((0.04, 1.2, 0.18), (0, 0, z), c) for z, c in ((0.85, (206, 60, 40)), (0.5, PALE))]
    feet = [box((0.5, 0.06, 0.06), (0, y, 0), DARK) for y in (-0.5, 0.5)]
    posts = [box((0.05, 0.05, 1.0), (-0.03, y, 0.03), DARK) for y in (-0.5, 0.5)]
    return finish(*planks, *feet, *posts)


def _wheeled(depth: float, width: float, height: float) -> Solid:
    """Wider above, with a lid; tinted."""
    low, high = height * 0.08, height * 0.9
    corners = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    sizes = ((low, 0.78), (high, 0.95))
    body = loft(
        [[(x * depth * s / 2, y * width * s / 2, z) for x, y in corners] for z, s in sizes], (176, 178, 176), True
    )
    tilted = [
        [(x * depth / 2, y * width / 2, high + (z if x < 0 else z * 0.4)) for x, y in corners]
        for z in (0, height * 0.12)
    ]
    back, away = -depth * 0.36, width * 0.42
    wheels = [tube([(back, side * away, 0.1), (back, side * away * 0.8, 0.1)], 0.1, 7, DARK) for side in (1, -1)]
    return join(body, loft(tilted, (226, 226, 224), True), *wheels)
