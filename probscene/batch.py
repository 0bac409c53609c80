"""What a renderer returns: images and the labels that come free with them."""

from typing import NamedTuple, Protocol

from torch import Tensor

from .request import Renderable


class SceneGeometry(NamedTuple):
    """What the render of a 3D scene has in addition; the camera's axes are KITTI's, see ``world``.

    Attributes:
        depth: ``(N, H, W)`` float32, metres along the camera's z; infinity where there is sky.
        semantic: ``(N, H, W)`` uint8 index into ``names``.
        names: what ``semantic`` means: ``"sky"``, the drawing's kinds in their order, the ground's surface names in
            the order in which they first occur, and ``"decoration"``.
        truncated: ``(N, M)`` float32, share of the amodal box, as large as it would be on an endless canvas, that lies
            outside the image.
        box: ``(N, M, 7)`` float32, the 3D box: height, width and length in metres, x, y, z of the middle of its bottom
            in the camera's axes, and its rotation about the camera's y axis, radians in -pi..pi, 0 where the object
            faces along the camera's x axis (``rotation_y`` of KITTI). Zeros where nothing is drawn.
        intrinsics: ``(N, 3, 3)`` float32.
    """

    depth: Tensor
    semantic: Tensor
    names: tuple[str, ...]
    truncated: Tensor
    box: Tensor
    intrinsics: Tensor


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
        visible: ``(N, M)`` float32, visible pixels over the pixels of the whole silhouette; 0 if that is empty. In 3D
            of the silhouette inside the image: what lies outside is ``space.truncated``.
        space: in 3D.
        unknown: which of ``"amodal_box"`` and ``"visible"`` the renderer cannot know, as other people's often cannot.
            Then they hold what is seen, ``box`` and 1 where there is a visible pixel, and are left out of labels.
        depth: ``(N, H, W)`` float32, metres, where there is no ``space`` and the renderer knows it.
    """

    image: Tensor
    instance: Tensor
    kind: Tensor
    box: Tensor
    amodal_box: Tensor
    pixels: Tensor
    visible: Tensor
    space: SceneGeometry | None = None
    unknown: tuple[str, ...] = ()
    depth: Tensor | None = None


class Renderer(Protocol):
    """Turns what a model's program returns into labelled pixels. Axis letters: N scenes, M nodes, H W of the canvas.

    A model names its own renderer in ``SceneModel.renderer``, a class or function that is called with the canvas,
    ``(H, W)``, and a number of threads, or None for one for every core; ``renderer(drawing)`` is all that is called
    on what it gives, again and again, with batches of any N. A drawing's ``kind (N, M)`` says what its nodes are,
    ``len(drawing)`` is N, ``drawing[a:b]`` are some of its scenes, and ``drawing.photo`` is what a camera makes of the
    images, None for nothing (``probscene.renderers.camera.effects.apply_camera_effects`` does it).

    It returns a ``RenderBatch`` on the CPU, with every field but ``space``, in the shapes and types named there:

    - ``image``, what a fit compares with photographs, RGB also where a model has one channel;
    - ``instance``, ``kind`` and ``pixels``, which go together: ids are node index + 1, only at nodes whose ``kind`` is
      the drawing's, not -1, and ``pixels`` counts them;
    - ``box``, ``amodal_box`` and ``visible``, from which detection labels are made and features trained;
    - ``space`` for worlds, where 3D labels are wanted (KITTI, depth); else None.

    Laws: M is the drawing's, also in columns that only pad. No value is NaN. A scene gives the same bytes whenever it
    is rendered, alone or among others, for any number of threads and in any process; so draw no random numbers from a
    global generator and keep nothing from call to call that shows. What the model samples goes in by the drawing.
    The first batch of a user's own renderer is checked for all of this, and a ``ModelError`` says what is wrong.
    """

    def __call__(self, drawing: Renderable) -> RenderBatch: ...
