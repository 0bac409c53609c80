"""What is known of ``LANES`` samples of a row while they are shaded."""

from ...engine import ti
from ...kernels.lanes import floats, whole

i32 = ti.i32


@ti.dataclass
class Samples:
    """What is known of samples before they are shaded, and their colours.

    ``alone`` whether all are of one record; ``u, v`` columns and rows; ``record`` of the visibility buffer, 0 in the
    sky; ``w`` 1/z and ``w_u, w_v`` its steps; over depth ``s, t`` texture coordinates with their steps and ``sun, up``
    cosines; ``lift`` metres by which light finds it nearer to the sun; ``table`` where the texture's row begins,
    ``wide, high`` its texels; ``red, green, blue`` the surface's colour and then the sample's.
    """

    alone: i32
    u: floats
    v: floats
    record: whole
    w: floats
    w_u: floats
    w_v: floats
    s: floats
    s_u: floats
    s_v: floats
    t: floats
    t_u: floats
    t_v: floats
    sun: floats
    up: floats
    lift: floats
    table: whole
    wide: floats
    high: floats
    red: floats
    green: floats
    blue: floats
