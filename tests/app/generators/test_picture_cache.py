"""Pictures that a generator drew before and that are kept in files."""

import numpy as np
import pytest

from probscene.errors import GeneratorError, MachineError
from probscene.renderers.generator.picture_cache import PictureCache
from probscene.renderers.generator.pool import pool_for
from probscene.renderers.generator.reply import Picture

SCENES = 24


def test_pictures_that_are_kept_are_taken_again(drawn, request_of, command, fault, fresh, tmp_path, same):
    request, keep = request_of(SCENES), tmp_path / "kept"
    fault("boxes")
    first = drawn(request, keep=keep)
    files = sorted(keep.rglob("*"))
    assert len([file for file in files if file.suffix == ".npz"]) == SCENES
    fresh()
    fault("always")
    again = drawn(request, keep=keep)
    assert same(again, first) and again.unknown == first.unknown == ("visible",)
    assert not pool_for(command(keep=keep), 1).processes() and sorted(keep.rglob("*")) == files
    next(file for file in files if file.suffix == ".npz").write_bytes(b"damaged")
    with pytest.raises(GeneratorError, match="never any mesh"):
        drawn(request, keep=keep, attempts=1)
    fresh()
    fault("boxes")
    assert same(drawn(request, keep=keep), first)


def test_a_damaged_picture_is_taken_as_none_or_as_it_was(command, tmp_path):
    nodes = [{"id": 1, "kind": "mug", "values": {}}, {"id": 2, "kind": "mug", "values": {}}]
    record = {"height": 16, "width": 20, "seed": 1, "values": {}, "nodes": nodes}
    draw = np.random.default_rng(0)
    picture = Picture(
        draw.integers(0, 255, (16, 20, 3), np.uint8, endpoint=True),
        draw.integers(0, 2, (16, 20), np.int16, endpoint=True),
        draw.random((16, 20), np.float32),
        draw.random((2, 4), np.float32),
    )
    kept = PictureCache(tmp_path, command())
    kept.save(record, picture)
    file = kept.file(record)
    whole = file.read_bytes()
    assert as_bytes(kept.load(record)) == as_bytes(picture)
    none = 0
    for _ in range(300):
        damaged = bytearray(whole)
        for at in draw.integers(0, len(whole), draw.integers(1, 40)):
            damaged[at] = draw.integers(0, 256)
        file.write_bytes(damaged)
        found = kept.load(record)
        none += found is None
        assert found is None or as_bytes(found) == as_bytes(picture)
    assert none > 200


@pytest.mark.parametrize(
    ("changed", "taken"),
    [
        ({}, True),
        ({"image": None}, False),
        ({"image": np.zeros((3, 4, 3), np.uint8)}, False),
        ({"instance": np.zeros((4, 4), np.float32)}, False),
        ({"depth": np.zeros((4, 4), np.float32)}, True),
        ({"depth": np.zeros((4, 4, 1), np.float32)}, False),
        ({"amodal_box": np.zeros((2, 4), np.float32)}, False),
    ],
)
def test_a_picture_that_is_kept_has_the_shape_of_its_scene(command, tmp_path, changed, taken):
    record = {"height": 4, "width": 4, "seed": 1, "values": {}, "nodes": [{"id": 1, "kind": "mug", "values": {}}]}
    kept = PictureCache(tmp_path, command())
    picture = Picture(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.int16), None, np.zeros((1, 4), np.float32))
    kept.save(record, picture._replace(**changed))
    assert (kept.load(record) is not None) == taken


def as_bytes(picture):
    return [None if part is None else (part.dtype.str, part.shape, part.tobytes()) for part in picture]


def test_another_command_has_pictures_of_its_own(drawn, request_of, tmp_path, fault, fresh):
    request = request_of(2)
    drawn(request, keep=tmp_path)
    fresh()
    fault("always")
    with pytest.raises(GeneratorError, match="never any mesh"):
        drawn(request, keep=tmp_path, files=(__file__,), attempts=1)


def test_a_folder_that_cannot_be_written_is_named(drawn, request_of, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MachineError, match="file.*, which keep= of the Command names, got Not a directory"):
        drawn(request_of(1), keep=tmp_path / "file")
