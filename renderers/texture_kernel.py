"""Where textures are read, at which of their levels, and the bilinear samples of them."""

from probscene.renderers.engine import ti
from probscene.renderers.lane_kernel import LANES, whole, words
from probscene.renderers.raster_kernel import high, low
from probscene.renderers.texture_atlas import AT, LEVELS

i32, u64, f32 = ti.i32, ti.u64, ti.f32
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
def texture_samples(z: ti.template(), some: ti.template(), table: ti.template(), texels: ti.template()):
    """Multiply the colours by the textures'; ``z`` are depths."""
    at, stride, across, down, mixed = whole(0), whole(0), whole(0), whole(0), words(0)
    for i in range(i32(LANES)):
        s, t = some.s[i] * z[i], some.t[i] * z[i]
        step_s = high(ti.abs(some.s_u[i] - s * some.w_u[i]), ti.abs(some.s_v[i] - s * some.w_v[i])) * z[i]
        step_t = high(ti.abs(some.t_u[i] - t * some.w_u[i]), ti.abs(some.t_v[i] - t * some.w_v[i])) * z[i]
        level_s, level_t = level(step_s * some.wide[i]), level(step_t * some.high[i])
        width = ti.max(ti.cast(some.wide[i], i32) >> level_s, i32(1))
        height = ti.max(ti.cast(some.high[i], i32) >> level_t, i32(1))
        at[i], stride[i] = some.table[i] + level_t * i32(LEVELS) + level_s + i32(AT), width + i32(2)
        across[i], down[i] = place(s, width), place(t, height)
    for i in range(i32(LANES)):
        j = table[at[i]] + (down[i] >> 8) * stride[i] + (across[i] >> 8)
        k = j + stride[i]
        right, low_share = ti.cast(across[i] & 255, u64), ti.cast(down[i] & 255, u64)
        near, below = texels[j], texels[k]
        beside, twist = texels[j + 1] - near, texels[k + 1] - below
        below -= near
        twist -= beside
        mixed[i] = (near << 8) + beside * right + below * low_share + twist * ((right * low_share + 128) >> 8)
    for i in range(i32(LANES)):
        some.red[i] = some.red[i] * (ti.cast(ti.cast(mixed[i] & 0xFFFF, i32), f32) * f32(1 / 65280))
        some.green[i] = some.green[i] * (ti.cast(ti.cast((mixed[i] >> 16) & 0xFFFF, i32), f32) * f32(1 / 65280))
        some.blue[i] = some.blue[i] * (ti.cast(ti.cast((mixed[i] >> 32) & 0xFFFF, i32), f32) * f32(1 / 65280))
