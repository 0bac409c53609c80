"""What a renderer of a user's own returns, checked: each fault is one clear ``ModelError``.

Axis letters: N scenes, M nodes, H W.
"""

import torch
from torch import Tensor

from .batch import RenderBatch, Renderer, SceneGeometry
from .errors import ModelError
from .request import Renderable


def call_name(renderer: Renderer) -> str:
    """What is called, for messages: ``MyRenderer.__call__``, or a function's own name."""
    return getattr(renderer, "__qualname__", f"{type(renderer).__qualname__}.__call__")


def check_renderer(renderer: Renderer, drawing: Renderable, canvas: tuple[int, int], batch: RenderBatch) -> None:
    """See that a batch is what ``Renderer`` promises, and that its first scene, rendered again alone, is the same.

    Args:
        renderer: who rendered it.
        drawing: of what; of at least one scene.
        canvas: height and width of the model's images, pixels.
        batch: what it returned.

    Raises:
        ModelError: it is something else.
    """
    name = call_name(renderer)
    _check_batch(name, batch, drawing, canvas)
    first = drawing[slice(0, 1)]
    again = renderer(first)
    _check_batch(name, again, first, canvas)
    for key, one, other in _pairs(batch, again):
        if not torch.equal(one[:1], other):
            raise ModelError(
                f"expected {name} to give the same bytes whenever it renders a scene, alone or among others, got "
                f"another {key} in a second call; draw no random numbers in it, and keep nothing from call to call."
            )


def _pairs(batch: RenderBatch, again: RenderBatch) -> list[tuple[str, Tensor, Tensor]]:
    each = [(key, getattr(batch, key), getattr(again, key)) for key in batch._fields]
    pairs = [(key, one, other) for key, one, other in each if isinstance(one, Tensor) and isinstance(other, Tensor)]
    if batch.space is not None and again.space is not None:
        parts = [key for key in SceneGeometry._fields if key != "names"]
        pairs += [(f"space.{key}", getattr(batch.space, key), getattr(again.space, key)) for key in parts]
    return pairs


def _check_batch(name: str, batch: RenderBatch, drawing: Renderable, canvas: tuple[int, int]) -> None:
    if not isinstance(batch, RenderBatch):
        raise ModelError(
            f"expected {name} to return a RenderBatch (probscene.batch), got {type(batch).__name__}; it has the "
            "labels beside the images."
        )
    N, M, (H, W) = *drawing.kind.shape, canvas
    _check_tensors(name, "", batch, {
        "image": (torch.uint8, (N, 3, H, W)), "instance": (torch.int16, (N, H, W)), "kind": (torch.int64, (N, M)),
        "box": (torch.float32, (N, M, 4)), "amodal_box": (torch.float32, (N, M, 4)),
        "pixels": (torch.int64, (N, M)), "visible": (torch.float32, (N, M)),
    })  # fmt: skip
    if batch.space is not None:
        if not isinstance(batch.space, SceneGeometry):
            raise ModelError(f"expected {name} to return a Space as space, or None, got {type(batch.space).__name__}.")
        _check_tensors(name, "space.", batch.space, {
            "depth": (torch.float32, (N, H, W)), "semantic": (torch.uint8, (N, H, W)),
            "truncated": (torch.float32, (N, M)), "box": (torch.float32, (N, M, 7)),
            "intrinsics": (torch.float32, (N, 3, 3)),
        })  # fmt: skip
        _demand(int(batch.space.semantic.max()) < len(batch.space.names), name, "space.semantic below the number of "
                f"space.names ({len(batch.space.names)})", f"{int(batch.space.semantic.max())}")  # fmt: skip
    _check_values(name, batch, drawing.kind, canvas)


def _check_tensors(name: str, prefix: str, values, expected: dict[str, tuple[torch.dtype, tuple[int, ...]]]) -> None:
    for key, (dtype, shape) in expected.items():
        value = getattr(values, key)
        if not isinstance(value, Tensor):
            raise ModelError(
                f"expected {name} to return {prefix}{key} as a tensor of {dtype} {shape}, got "
                f"{type(value).__name__}; torch.from_numpy makes one of an array."
            )
        if value.dtype != dtype or tuple(value.shape) != shape:
            raise ModelError(
                f"expected {name} to return {prefix}{key} as {dtype} {shape} (N scenes first, M nodes, the canvas's "
                f"height and width), got {value.dtype} {tuple(value.shape)}; convert it there."
            )
        if value.is_floating_point() and value.isnan().any():
            raise ModelError(f"expected {name} to return {prefix}{key} without NaN, got NaN; zeros where nothing is.")


def _check_values(name: str, batch: RenderBatch, drawn: Tensor, canvas: tuple[int, int]) -> None:
    (N, M), ids = drawn.shape, batch.instance.long()
    _demand(0 <= int(ids.min()) and int(ids.max()) <= M, name, f"instance in 0..{M}, node index + 1, 0 for none",
            f"{int(ids.min())}..{int(ids.max())}")  # fmt: skip
    wrong = (batch.kind != drawn) & (batch.kind != -1)
    _demand(not wrong.any(), name, "kind as the drawing's, or -1 at nodes without a label",
            f"{int(batch.kind[wrong][0]) if wrong.any() else 0} where the drawing has "
            f"{int(drawn[wrong][0]) if wrong.any() else 0}")  # fmt: skip
    found = torch.zeros(N, M + 1, dtype=torch.int64)
    found.scatter_add_(1, ids.flatten(1), torch.ones_like(ids.flatten(1)))
    _demand(not (found[:, 1:] * (batch.kind < 0)).any(), name, "instance ids of nodes that kind labels",
            "pixels of a node whose kind is -1")  # fmt: skip
    _demand(torch.equal(found[:, 1:], batch.pixels), name, "pixels as instance has them, node by node", "other numbers")
    _demand(bool(((batch.visible >= 0) & (batch.visible <= 1)).all()), name, "visible in 0..1, a share of pixels",
            f"{float(batch.visible.min()):.3g}..{float(batch.visible.max()):.3g}")  # fmt: skip
    low, high = batch.box[..., :2], batch.box[..., 2:]
    inside = (low >= 0) & (low <= high) & (high <= torch.tensor(canvas[::-1]))
    _demand(bool(inside.all()), name, f"box as x0, y0, x1, y1 on the canvas of {canvas[1]} x {canvas[0]} pixels",
            f"{batch.box[~inside.all(-1)][:1].flatten().tolist()}")  # fmt: skip
    upright = batch.amodal_box[..., :2] <= batch.amodal_box[..., 2:]
    _demand(bool(upright.all()), name, "amodal_box as x0, y0, x1, y1 with x0 <= x1 and y0 <= y1",
            f"{batch.amodal_box[~upright.all(-1)][:1].flatten().tolist()}")  # fmt: skip


def _demand(holds: bool, name: str, expected: str, actual: str) -> None:
    if not holds:
        raise ModelError(f"expected {name} to return {expected}, got {actual}; see RenderBatch in probscene.batch.")
