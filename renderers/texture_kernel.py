"""Where a texture is read, at which of its levels, and the bilinear sample of it."""

from probscene.renderers.engine import ti

i32, i64, u64, f32 = ti.i32, ti.i64, ti.u64, ti.f32


@ti.func
def level(texels: f32, levels: i32):
    """The level at which steps of so many texels are nearest to one, on a scale of logarithms."""
    return ti.min(ti.max((ti.bit_cast(texels * f32(1.41421356), i32) >> 23) - 127, 0), levels - 1)


@ti.func
def place(coordinate: f32, size: f32, most: i32):
    """A texture coordinate as a position in 1/256 of a texel of a framed level, of which 0 is the frame."""
    rest = coordinate - ti.cast(ti.cast(coordinate, i64), f32)
    rest += ti.select(rest < 0, f32(1.0), f32(0.0))
    return ti.min(ti.max(ti.cast(rest * size, i32) + 128, 0), most)


@ti.func
def sample(u: i32, v: i32, at: i32, stride: i32, texels: ti.template()):
    """Bilinear sample; three lanes, each 65280 times the share."""
    i = at + (v >> 8) * stride + (u >> 8)
    j = i + stride
    across, down = ti.cast(u & 255, u64), ti.cast(v & 255, u64)
    near, below = texels[i], texels[j]
    right, twist = texels[i + 1] - near, texels[j + 1] - below
    below -= near
    twist -= right
    return (near << 8) + right * across + below * down + twist * ((across * down + 128) >> 8)
