"""Pixels of an image side by side, in local arrays: what a loop over them computes, the compiler does for several at
once. Arguments' arrays stop it from that, since anything written to one may change where the others lie: after each
write it asks again. So where all ``LANES`` pixels of a block are written, whole words of 64 bits are, and blocks begin
where these do: at multiples of ``LANES`` of all the images' pixels. What is read and then written there is an element
of an array of vectors, of which it asks once.

A ``ti.real_func`` asks once as well, for all that it does, so its loops over arrays are computed side by side: spans of
triangles are drawn by such, in whole ``LANES``. What it calls may hold no branch and no loop, which Taichi 1.7 would
put into the kernel instead. It is as fast only where LLVM puts it into the kernel, so it is called from one or two
places.

A kernel calls one real function and no other. Taichi 1.7 names a compiled kernel in its cache by the real functions as
well, in the order of their addresses: with a second one every process finds another name, and compiles it anew.
"""

from ..engine import ti

LANES, SHIFT = 16, 4  # SHIFT: bits of a place within a block

i32, u32, u64, f32 = ti.i32, ti.u32, ti.u64, ti.f32
floats, whole, natural, words = (ti.types.vector(LANES, kind) for kind in (f32, i32, u32, u64))


@ti.func
def whole_lanes(count: i32):
    """The least multiple of ``LANES`` that is not below."""
    return (count + i32(LANES - 1)) & i32(-LANES)


@ti.func
def low(a, b):
    """The lesser; ti.min takes several instructions, for the sake of NaN."""
    return ti.select(a < b, a, b)


@ti.func
def high(a, b):
    """The greater."""
    return ti.select(a > b, a, b)
