"""Where textures are read, at which of their levels, and the bilinear samples of them."""

from ...engine import ti
from ...kernels.lanes import LANES, high, low, natural, whole
from ..tables.texture_atlas import AT, LEVELS

i32, u32, f32 = ti.i32, ti.u32, ti.f32
PAIR = 0x00FF00FF  # red and blue of a texel
FAR = 1e9  # whole numbers beyond this have no fraction in f32, and none beyond 2^31 is an i32


@ti.func
def level(texels: f32):
    """The level at which steps of so many texels are nearest to one, on a scale of logarithms."""
    return ti.min(ti.max((ti.bit_cast(texels * f32(1.41421356), i32) >> 23) - i32(127), i32(0)), i32(LEVELS - 1))


@ti.func
def place(coordinate: f32, size: i32):
    """A texture coordinate as a position in 1/256 of a texel of a framed level, of which 0 is the frame."""
    bounded = low(high(coordinate, f32(-FAR)), f32(FAR))
    rest = bounded - ti.cast(ti.cast(bounded, i32), f32)
    rest += ti.select(rest < 0, f32(1.0), f32(0.0))
    return ti.min(ti.max(ti.cast(rest * ti.cast(size << 8, f32), i32) + i32(128), i32(0)), (size << 8) + i32(255))


@ti.func
def mixed(near: u32, beside: u32, below: u32, opposite: u32, right: u32, low_share: u32, twisted: u32):
    """Bytes 16 bits apart by shares of 256: 255 times 256 of them, which fit."""
    return (near << 8) + (beside - near) * right + (below - near) * low_share + (
        opposite - below - beside + near) * twisted  # fmt: skip


@ti.func
def texture_samples(z: ti.template(), some: ti.template(), table: ti.template(), texels: ti.template()):
    """Multiply the colours by the textures'; ``z`` are depths."""
    at, place_in, stride, across, down = whole(0), whole(0), whole(0), whole(0), whole(0)
    near, beside, below, opposite = natural(0), natural(0), natural(0), natural(0)
    for i in range(i32(LANES)):
        s, t = some.s[i] * z[i], some.t[i] * z[i]
        step_s = high(ti.abs(some.s_u[i] - s * some.w_u[i]), ti.abs(some.s_v[i] - s * some.w_v[i])) * z[i]
        step_t = high(ti.abs(some.t_u[i] - t * some.w_u[i]), ti.abs(some.t_v[i] - t * some.w_v[i])) * z[i]
        level_s, level_t = level(step_s * some.wide[i]), level(step_t * some.high[i])
        width = ti.max(ti.cast(some.wide[i], i32) >> level_s, i32(1))
        height = ti.max(ti.cast(some.high[i], i32) >> level_t, i32(1))
        at[i], stride[i] = some.table[i] + level_t * i32(LEVELS) + level_s + i32(AT), width + i32(2)
        column, row = place(s, width), place(t, height)
        across[i], down[i] = ti.cast(column & 255, i32), ti.cast(row & 255, i32)
        place_in[i] = ti.cast((row >> 8) * stride[i] + (column >> 8), i32)
    for i in range(i32(LANES)):
        j = table[at[i]] + place_in[i]
        upper, lower = texels[j], texels[j + stride[i]]
        near[i], beside[i] = ti.cast(upper, u32), ti.cast(upper >> 32, u32)
        below[i], opposite[i] = ti.cast(lower, u32), ti.cast(lower >> 32, u32)
    for i in range(i32(LANES)):
        right, low_share = ti.cast(across[i], u32), ti.cast(down[i], u32)
        twisted = (right * low_share + 128) >> 8
        a, b, c, d = near[i], beside[i], below[i], opposite[i]
        pair = mixed(a & PAIR, b & PAIR, c & PAIR, d & PAIR, right, low_share, twisted)
        a, b, c, d = a >> 8, b >> 8, c >> 8, d >> 8
        green = mixed(a & 255, b & 255, c & 255, d & 255, right, low_share, twisted)
        some.red[i] = some.red[i] * (ti.cast(ti.cast(pair & 0xFFFF, i32), f32) * f32(1 / 65280))
        some.green[i] = some.green[i] * (ti.cast(ti.cast(green, i32), f32) * f32(1 / 65280))
        some.blue[i] = some.blue[i] * (ti.cast(ti.cast(pair >> 16, i32), f32) * f32(1 / 65280))
