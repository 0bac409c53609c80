"""Laws of the sprite renderer, against its numpy twin and against itself."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.sprites import ReferenceRenderer, spread

from probscene.batch import RenderBatch
from probscene.drawing import Atlas, Drawing, Layer, Sprites, box, disc, resolve
from probscene.errors import ModelError
from probscene.renderers.sprites import SpriteRenderer
from probscene.renderers.sprites import renderer as sprites_module

CANVAS = (37, 43)
RENDERER = SpriteRenderer(CANVAS, threads=1)


def _atlas(generator) -> Atlas:
    """Noise of every sort of outline, and the two that the core has."""
    sprites = [disc(), box()]
    for sort in range(5):
        height, width = generator.integers(1, 18, 2)
        sprite = generator.integers(0, 256, (height, width, 4)).astype(np.uint8)
        if sort == 0:
            sprite[..., 3] = 255
        if sort == 1:
            sprite[..., 3] = generator.choice([0, 255], (height, width))
        if sort == 2:  # opaque within a clear border
            sprite = np.pad(sprite, ((2, 1), (1, 3), (0, 0)))
            sprite[2:-1, 1:-3, 3] = 255
        if sort == 3:
            sprite[..., 3] = 0
        sprites.append(sprite)
    return Atlas(tuple(sprites))


def _layer(generator, shape, atlas, labelled=True, present=None, **fixed) -> Layer:
    values = {
        "x": generator.uniform(-8, CANVAS[1] + 8, shape),
        "y": generator.uniform(-8, CANVAS[0] + 8, shape),
        "angle": generator.uniform(-4, 4, shape) * generator.integers(0, 2, shape),
        "scale_x": np.exp(generator.uniform(-4, 1, shape)),
        "scale_y": np.exp(generator.uniform(-4, 1, shape)),
        "tint": generator.uniform(0, 1, (*shape, 3)),
    } | fixed
    return Layer(
        atlas=atlas,
        present=torch.from_numpy(generator.random(shape) < 0.8) if present is None else present,
        sprite=torch.from_numpy(generator.integers(0, len(atlas), shape)),
        labelled=labelled,
        **{k: torch.from_numpy(np.broadcast_to(v, np.shape(v) or shape).astype(np.float32)) for k, v in values.items()},
    )


@st.composite
def drawings(draw, labelled=None) -> Drawing:
    """Random drawings of 0 to 3 scenes, 0 to 4 nodes and 0 to 3 layers."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.tuples(st.integers(0, 3), st.integers(0, 4)))
    flags = draw(st.lists(st.booleans(), max_size=3)) if labelled is None else [labelled]
    layers = tuple(_layer(generator, shape, _atlas(generator), flag) for flag in flags)
    background = tuple(generator.uniform(0, 1, 3)) if generator.random() < 0.5 else (0.0, 0.0, 0.0)
    return Drawing(torch.from_numpy(generator.integers(0, 2, shape)), ("a", "b"), layers, background)


def _one(sprite, x, y, canvas=CANVAS, background=(0.0, 0.0, 0.0), **options) -> Drawing:
    """One scene with one sprite."""
    layer = resolve(Sprites("a", Atlas((sprite,)), 0, x, y, **options), torch.ones(1, 1, dtype=torch.bool))
    return Drawing(torch.zeros(1, 1, dtype=torch.int64), ("a",), (layer,), background)


def _tensors(batch):
    """Of a batch in 2D, which has no ``space``."""
    assert batch.space is None
    return batch[:7]


def _same(a, b):
    a, b = (_tensors(batch) if isinstance(batch, RenderBatch) else batch for batch in (a, b))
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def _opaque(generator, height, width):
    sprite = generator.integers(0, 256, (height, width, 4)).astype(np.uint8)
    sprite[..., 3] = 255
    return sprite


@settings(max_examples=100)
@given(drawings())
def test_agrees_with_the_numpy_twin(drawing):
    ours, twin = RENDERER(drawing), ReferenceRenderer(CANVAS)(drawing)
    assert [tensor.dtype for tensor in _tensors(ours)] == [tensor.dtype for tensor in _tensors(twin)]
    assert [tensor.shape for tensor in _tensors(ours)] == [tensor.shape for tensor in _tensors(twin)]
    assert torch.equal(ours.kind, twin.kind)
    assert not len(drawing) or (ours.image.int() - twin.image.int()).abs().max() <= 2

    doubtful = np.zeros((len(drawing), *CANVAS), bool)  # some sprite's alpha is within rounding of one half
    outside = torch.zeros(drawing.kind.shape)
    for layer in drawing.layers:
        for n, m in layer.present.nonzero().tolist():
            x0, y0, _, alpha = spread(layer, n, m)
            rows, columns = np.nonzero(np.abs(alpha - 127.5) < 2)
            outside[n, m] += len(rows)
            rows, columns = rows + y0, columns + x0
            on = (rows >= 0) & (rows < CANVAS[0]) & (columns >= 0) & (columns < CANVAS[1])
            doubtful[n, rows[on], columns[on]] = True
    assert torch.equal(ours.instance[~doubtful], twin.instance[~doubtful])
    if not doubtful.any() and not outside.any():
        assert torch.equal(ours.box, twin.box) and torch.equal(ours.amodal_box, twin.amodal_box)
        assert torch.equal(ours.pixels, twin.pixels) and torch.equal(ours.visible, twin.visible)


@given(drawings())
def test_labels_alone_are_those_of_the_pictures(drawing):
    pictured, alone = RENDERER(drawing), RENDERER.labels(drawing)
    assert not alone.image.any() and alone.image.shape == pictured.image.shape
    assert _same(alone._replace(image=pictured.image), pictured)


@given(st.integers(0, 2**32 - 1), st.floats(0.3, 3.0), st.floats(-3.0, 3.0))
def test_labels_alone_begin_at_half_alpha(seed, scale, angle):
    generator, scenes = np.random.default_rng(seed), 16
    alphas = np.arange(120, 120 + scenes)
    looks = [np.full((11, 11, 4), alpha, np.uint8) for alpha in alphas]
    looks += [np.pad(generator.integers(alpha, alpha + 3, (9, 9, 4)), ((2, 1), (1, 2), (0, 0))) for alpha in alphas]
    atlas = Atlas(tuple(look.astype(np.uint8) for look in looks))
    sprites = Sprites("a", atlas, torch.arange(2 * scenes)[:, None], 20.3, 18.6, angle=angle, scale=scale)
    layer = resolve(sprites, torch.ones(2 * scenes, 1, dtype=torch.bool))
    drawing = Drawing(torch.zeros(2 * scenes, 1, dtype=torch.int64), ("a",), (layer,))
    pictured, alone = RENDERER(drawing), RENDERER.labels(drawing)
    assert 0 < (pictured.pixels > 0).sum() < 2 * scenes
    assert _same(alone._replace(image=pictured.image), pictured)


@given(drawings())
def test_boxes_and_pixels_are_those_of_the_masks(drawing):
    batch = RENDERER(drawing)
    for n, m in np.ndindex(*drawing.kind.shape):
        rows, columns = np.nonzero(batch.instance[n].numpy() == m + 1)
        extent = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] if len(rows) else [0, 0, 0, 0]
        assert batch.box[n, m].tolist() == extent
        assert batch.pixels[n, m] == len(rows)
    known = torch.zeros(drawing.kind.shape, dtype=torch.bool)
    for layer in drawing.layers:
        known |= layer.present & layer.labelled
    assert torch.equal(batch.kind, torch.where(known, drawing.kind, -1))


@given(drawings(labelled=True))
def test_silhouettes_are_those_of_each_sprite_alone_on_a_larger_canvas(drawing):
    pad = 256
    (layer,) = drawing.layers
    layer = Layer(
        **{**vars(layer), "x": (layer.x * 64).round() / 64, "y": (layer.y * 64).round() / 64}
    )  # x + pad exact
    batch = RENDERER(Drawing(drawing.kind, drawing.kinds, (layer,)))
    shifted = {**vars(layer), "x": layer.x + pad, "y": layer.y + pad}
    for m in range(drawing.kind.shape[1]):
        alone = layer.present & (torch.arange(layer.present.shape[1]) == m)
        single = Drawing(drawing.kind, drawing.kinds, (Layer(**{**shifted, "present": alone}),))
        whole = SpriteRenderer((CANVAS[0] + 2 * pad, CANVAS[1] + 2 * pad), threads=1)(single)
        seen = whole.pixels[:, m] > 0
        assert torch.equal(batch.amodal_box[:, m], torch.where(seen[:, None], whole.box[:, m] - pad, 0))
        expected = torch.where(seen, batch.pixels[:, m] / whole.pixels[:, m].clamp(min=1), 0)
        assert torch.equal(batch.visible[:, m], expected.float())
        assert (whole.visible[:, m] == seen).all()


@given(drawings(), st.integers(0, 3))
def test_same_bytes_for_any_threads_and_any_batch(drawing, cut):
    batch = RENDERER(drawing)
    assert _same(batch, SpriteRenderer(CANVAS, threads=2)(drawing))
    for part in (slice(0, cut), slice(cut, None), slice(cut, cut + 1)):
        assert _same((tensor[part] for tensor in _tensors(batch)), RENDERER(drawing[part]))


def test_same_bytes_for_several_launches(monkeypatch):
    generator = np.random.default_rng(0)
    shape = (11, 3)
    drawing = Drawing(torch.zeros(shape, dtype=torch.int64), ("a",), (_layer(generator, shape, _atlas(generator)),))
    batch = RENDERER(drawing)
    monkeypatch.setattr(sprites_module, "_CHUNK", 1)
    assert _same(batch, SpriteRenderer(CANVAS, threads=2)(drawing))


def test_many_scenes_on_two_threads_are_each_drawn_once():
    generator = np.random.default_rng(0)
    shape = (700, 2)
    layer = _layer(generator, shape, _atlas(generator), tint=np.full((*shape, 3), 0.5))
    drawing = Drawing(torch.zeros(shape, dtype=torch.int64), ("a",), (layer,))
    assert _same(RENDERER(drawing), SpriteRenderer(CANVAS, threads=2)(drawing))


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(1, 30), st.integers(-20, 40), st.integers(-20, 40))
def test_texels_on_pixels_keep_their_bytes(seed, height, width, left, top):
    sprite = _opaque(np.random.default_rng(seed), height, width)
    batch = RENDERER(_one(sprite, left + width / 2, top + height / 2))
    canvas = np.zeros((120, 120, 3), np.uint8)  # 40 pixels around CANVAS
    canvas[top + 40 : top + 40 + height, left + 40 : left + 40 + width] = sprite[..., :3]
    inside = slice(40, 40 + CANVAS[0]), slice(40, 40 + CANVAS[1])
    np.testing.assert_array_equal(batch.image[0].permute(1, 2, 0).numpy(), canvas[inside])
    assert batch.amodal_box[0, 0].tolist() == [left, top, left + width, top + height]


@pytest.mark.parametrize("turns", [1, 2, 3, 4])
def test_quarter_turns_are_anticlockwise_and_exact(turns):
    sprite = _opaque(np.random.default_rng(0), 12, 12)
    angle = float(np.float32(turns * np.pi / 2))
    batch = RENDERER(_one(sprite, 20.0, 18.0, angle=angle))
    np.testing.assert_array_equal(
        batch.image[0, :, 12:24, 14:26].permute(1, 2, 0).numpy(), np.rot90(sprite, turns)[..., :3]
    )


def test_magnified_edges_are_sharp_and_in_place():
    batch = RENDERER(_one(box(1), 20.0, 15.0, scale=12.0, scale_y=4.5))
    column, row = batch.image[0, 0, :, 20].tolist(), batch.image[0, 0, 15].tolist()
    assert row == [0] * 14 + [255] * 12 + [0] * 17
    assert column[:18] == [0] * 12 + [64] + [255] * 4 + [64]  # 12.75 to 17.25
    assert not any(column[18:])


def test_small_sprites_fade_with_their_area():
    batch = RENDERER(_one(box(8), 20.5, 15.5, scale=1 / 16))
    assert 60 <= int(batch.image[0, 0].sum()) <= 68  # a quarter of a pixel
    assert batch.pixels.item() == 0 and batch.visible.item() == 0 and batch.kind.item() == 0
    assert not RENDERER(_one(box(8), 20.5, 15.5, scale=1e-30)).image.any()


def test_later_nodes_and_layers_cover_earlier_ones():
    present = torch.ones(1, 2, dtype=torch.bool)
    x, red, blue = torch.tensor([[10.0, 14.0]]), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    back = resolve(
        Sprites.box("a", x, 10.0 * torch.ones(1, 2), torch.tensor(8.0), torch.tensor(8.0), tint=red), present
    )
    cover = resolve(
        Sprites.box(
            "a", x + 6, 10.0 * torch.ones(1, 2), torch.tensor(4.0), torch.tensor(8.0), tint=blue, labelled=False
        ),
        present,
    )
    kind = torch.zeros(1, 2, dtype=torch.int64)
    batch = RENDERER(Drawing(kind, ("a",), (back,)))
    assert batch.instance[0, 10, 5:20].tolist() == [0] + [1] * 4 + [2] * 8 + [0] * 2
    assert batch.visible.tolist() == [[0.5, 1.0]]
    assert batch.amodal_box.tolist() == [[[6, 6, 14, 14], [10, 6, 18, 14]]]

    batch = RENDERER(Drawing(kind, ("a",), (back, cover)))  # the cover spans 14..18 and 18..22
    assert batch.instance[0, 10, 5:20].tolist() == [0] + [1] * 4 + [2] * 4 + [0] * 6
    assert batch.image[0, :, 10, 15].tolist() == [0, 0, 255] and batch.image[0, :, 10, 12].tolist() == [255, 0, 0]
    assert batch.visible.tolist() == [[0.5, 0.5]]
    batch = RENDERER(Drawing(kind, ("a",), (cover, back)))
    assert batch.visible.tolist() == [[0.5, 1.0]]
    batch = RENDERER(Drawing(kind, ("a",), (cover,)))
    assert not batch.instance.any() and batch.kind.tolist() == [[-1, -1]] and not batch.amodal_box.any()


def test_a_node_that_two_layers_draw_is_one_silhouette():
    present = torch.ones(1, 1, dtype=torch.bool)
    one = torch.ones(1, 1)
    body = resolve(Sprites.box("a", 10 * one, 10 * one, 8 * one, 4 * one), present)
    head = resolve(Sprites.box("a", 10 * one, 5 * one, 4 * one, 4 * one), present)
    batch = RENDERER(Drawing(torch.zeros(1, 1, dtype=torch.int64), ("a",), (body, head)))
    assert batch.box.tolist() == batch.amodal_box.tolist() == [[[6, 3, 14, 12]]]
    assert batch.pixels.item() == 48 and batch.visible.item() == 1


def test_background_and_tint():
    batch = RENDERER(_one(box(4), 10.0, 10.0, background=(0.2, 0.4, 1.0), tint=(1.0, 0.5, 0.0)))
    assert batch.image[0, :, 0, 0].tolist() == [51, 102, 255]
    assert batch.image[0, :, 10, 10].tolist() == [255, 128, 0]


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (2, 0), (2, 1)])
@pytest.mark.parametrize("layers", [0, 1])
def test_empty_scenes(shape, layers):
    generator = np.random.default_rng(0)
    nothing = torch.zeros(shape, dtype=torch.bool)
    layer = _layer(generator, shape, _atlas(generator), present=nothing, scale_x=np.zeros(shape))
    batch = RENDERER(Drawing(torch.full(shape, -1), ("a",), (layer,) * layers))
    assert batch.image.shape == (shape[0], 3, *CANVAS) and not batch.image.any()
    assert batch.instance.shape == (shape[0], *CANVAS) and not batch.instance.any()
    assert batch.box.shape == batch.amodal_box.shape == (*shape, 4)
    assert (batch.kind == -1).all() and not batch.visible.any()


def test_the_last_of_very_many_nodes_has_its_id():
    present = torch.zeros(1, 32767, dtype=torch.bool)
    present[0, -1] = True
    layer = resolve(Sprites("a", Atlas((box(),)), 0, torch.tensor(20.0), torch.tensor(20.0)), present)
    batch = RENDERER(Drawing(torch.zeros(1, 32767, dtype=torch.int64), ("a",), (layer,)))
    assert batch.instance[0, 20, 20] == 32767 and batch.pixels[0, -1] == 64


def test_the_batch_owns_its_memory():
    drawing = _one(_opaque(np.random.default_rng(0), 9, 9), 20.0, 20.0)
    first = RENDERER(drawing)
    kept = [tensor.clone() for tensor in _tensors(first)]
    RENDERER(_one(box(), 9.0, 9.0))
    RENDERER(drawing).image.zero_()
    assert _same(first, kept)


def test_sprites_are_made_again_once_the_sheet_has_been_full(monkeypatch):
    generator = np.random.default_rng(0)
    shape = (3, 4)
    drawing = Drawing(torch.zeros(shape, dtype=torch.int64), ("a",), (_layer(generator, shape, _atlas(generator)),))
    monkeypatch.setattr("probscene.renderers.sprites.sheet._LIMIT", 0)
    renderer = SpriteRenderer(CANVAS, threads=1)
    batches = [renderer(drawing) for _ in range(3)]
    assert _same(batches[0], RENDERER(drawing)) and _same(batches[1], batches[0]) and _same(batches[2], batches[0])


@pytest.mark.parametrize(
    ("fixed", "message"),
    [
        ({"scale_x": 0.0}, "positive scale_x"),
        ({"scale_y": -1.0}, "positive scale_y"),
        ({"x": float("nan")}, "finite x"),
        ({"angle": float("inf")}, "finite angle"),
        ({"tint": np.full((1, 1, 3), np.nan)}, "finite tint"),
        ({"y": 1e9}, "within 16777216 pixels"),
        ({"scale_x": 1e4, "scale_y": 1e4}, "64 canvases"),
        ({"scale_x": 1e30, "scale_y": 1e-30}, "64 canvases"),
    ],
)
def test_what_cannot_be_drawn_is_named(fixed, message):
    shape = (1, 1)
    generator = np.random.default_rng(0)
    present = torch.ones(shape, dtype=torch.bool)
    layer = _layer(generator, shape, Atlas((box(),)), present=present, **fixed)
    drawing = Drawing(torch.zeros(shape, dtype=torch.int64), ("a",), (layer,))
    with pytest.raises(ModelError, match=message):
        RENDERER(drawing)
    absent = Layer(**{**vars(layer), "present": ~present})
    assert not RENDERER(Drawing(drawing.kind, ("a",), (absent,))).image.any()


def test_malformed_drawings_are_named():
    generator = np.random.default_rng(0)
    layer = _layer(generator, (2, 2), Atlas((box(),)), present=torch.ones(2, 2, dtype=torch.bool))
    kind = torch.zeros(2, 2, dtype=torch.int64)
    for sprite in (-1, 1):
        wrong = Layer(**{**vars(layer), "sprite": torch.full((2, 2), sprite)})
        with pytest.raises(ModelError, match=r"in 0\.\.0"):
            RENDERER(Drawing(kind, ("a",), (wrong,)))
    with pytest.raises(ModelError, match="layer 0"):
        RENDERER(Drawing(kind[:1], ("a",), (layer,)))
    with pytest.raises(ModelError, match="32767 nodes"):
        RENDERER(Drawing(torch.zeros(1, 32768, dtype=torch.int64), ("a",), ()))


@pytest.mark.parametrize(("canvas", "threads"), [((0, 5), 1), ((5, -1), 1), ((1 << 14, 1 << 14), 1), ((5, 5), 0)])
def test_malformed_renderers_are_named(canvas, threads):
    with pytest.raises(ModelError, match="expected"):
        SpriteRenderer(canvas, threads)
