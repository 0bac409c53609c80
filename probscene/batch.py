"""What a renderer returns: images and the labels that come free with them."""

from typing import NamedTuple, Protocol

from torch import Tensor

from probscene.drawing import Drawing


class RenderBatch(NamedTuple):
    """A batch of rendered scenes. Axis letters: N scenes, M nodes, C H W.

    Attributes:
        image: ``(N, 3, H, W)`` uint8 RGB (a view of interleaved storage, channels last).
        instance: ``(N, H, W)`` int16, node index + 1 of the visible node, 0 where there is none.
        kind: ``(N, M)`` int64 index into the drawing's kinds; -1 pads and at nodes that are not drawn with a label.
        box: ``(N, M, 4)`` float32 x0, y0, x1, y1 in pixels, the extent of the visible mask, ends exclusive; zeros if
            there is none.
        amodal_box: ``(N, M, 4)`` the extent of the whole silhouette, what others cover and what lies outside the canvas
            included; zeros if the silhouette is empty.
        pixels: ``(N, M)`` int64, visible pixels.
        visible: ``(N, M)`` float32, visible pixels over the pixels of the whole silhouette; 0 if that is empty.
    """

    image: Tensor
    instance: Tensor
    kind: Tensor
    box: Tensor
    amodal_box: Tensor
    pixels: Tensor
    visible: Tensor


class Renderer(Protocol):
    """Turns a drawing into labelled pixels; a drawing gives the same bytes for any batch size and thread count."""

    def __call__(self, drawing: Drawing) -> RenderBatch: ...
