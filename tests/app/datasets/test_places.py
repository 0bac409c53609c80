"""Datasets at addresses: an S3 server of a package, on this machine, holds what a folder does."""

import os

import pytest
from fsspec.core import url_to_fs

from probscene.app.datasets.generate import DatasetOptions, generate
from probscene.app.datasets.places import PARTS, RemotePlace
from probscene.errors import DataError, MachineError, ProbsceneError

from .conftest import contents

moto_server = pytest.importorskip("moto.server")
pytestmark = pytest.mark.filterwarnings("ignore")  # the server's own
FORMATS = "coco,yolo,kitti,webdataset"


@pytest.fixture(scope="module")
def server():
    """An S3 server; where it is and with which rights is told as to every program that uses S3."""
    server = moto_server.ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    words = {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_ACCESS_KEY_ID": "me", "AWS_SECRET_ACCESS_KEY": "secret"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**words, "AWS_DEFAULT_REGION": "us-east-1", "NO_PROXY": host}.items():
            patch.setenv(name, value)
        yield
    server.stop()


@pytest.fixture
def bucket(server, request):
    """An empty bucket."""
    name = f"bucket{abs(hash(request.node.name))}"
    url_to_fs("s3://")[0].mkdir(name)
    return f"s3://{name}"


def there(address):
    """The files under an address."""
    files, root = url_to_fs(address, use_listings_cache=False)
    return {name.removeprefix(f"{root}/"): files.cat_file(name) for name in files.find(root)}


@pytest.mark.parametrize(("format", "num"), [("images", 70), ("webdataset", 70), (FORMATS, 10)])
def test_an_address_holds_what_a_folder_does(run, bucket, tmp_path, format, num):
    made = generate(run, num, f"{bucket}/made", seed=3, format=format)
    assert made.made == num and made.finished and made.path == f"{bucket}/made"
    generate(run, num, tmp_path / "out", seed=3, format=format)
    assert there(f"{bucket}/made") == contents(tmp_path / "out")
    assert generate(run, num, f"{bucket}/made", seed=3, format=format).made == 0


def test_it_goes_on_where_it_was_interrupted_and_what_is_damaged_is_made_again(run, tmp_path, bucket, ready_workers):
    address = f"{bucket}/out"

    def stop(number, _):
        if number:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(run, 70, address, seed=3, format="coco", progress=stop)
    assert "annotations.json" not in there(address) and len(there(address)) == 64 + 2
    files, root = url_to_fs(address)
    assert generate(run, 70, address, seed=3, format="coco", options=DatasetOptions(shard="1/2")).made == 6
    files.pipe_file(f"{root}/images/000064.png", b"half")
    assert generate(run, 70, address, seed=3, format="coco", workers=2).made == 6
    generate(run, 70, tmp_path / "out", seed=3, format="coco")
    assert there(address) == contents(tmp_path / "out")


def test_what_another_put_there_stays(run, bucket):
    files, root = url_to_fs(bucket)
    files.pipe_file(f"{root}/out/mine.txt", b"mine")
    with pytest.raises(DataError, match="expected a new or empty folder .*got s3://.* with mine.txt in it"):
        generate(run, 4, f"{bucket}/out")
    generate(run, 4, f"{bucket}/other", seed=1)
    with pytest.raises(DataError, match=r"begun with \(seed 1\), got seed 2"):
        generate(run, 4, f"{bucket}/other", seed=2)
    assert there(f"{bucket}/out") == {"mine.txt": b"mine"}


@pytest.mark.parametrize("address", ["s3://no-such-bucket-here/out", "s3://Not_A_Bucket/out"])
def test_a_place_that_is_not_there_is_one_line(server, call, run, address):
    result = call("generate", run.path, "--num", 4, "--out", address)
    assert result.code == 1 and result.err.splitlines()[-1].startswith(
        f"probscene: expected to read and write {address}"
    )
    assert "Traceback" not in result.err


def test_an_unknown_kind_of_address(call, fitted, tmp_path):
    result = call("generate", fitted, "--num", 4, "--out", "nothing://bucket/out")
    assert result.code == 2 and "an address of a file system that fsspec knows, got nothing://bucket/out" in result.err


@pytest.mark.parametrize("address", ["s3://", "s3:///", "memory://", "file://"])
def test_an_address_without_a_place_is_an_error(call, fitted, address):
    result = call("generate", fitted, "--num", 4, "--out", address)
    assert result.code == 2 and f"expected an address with a place, such as {address[:4]}" in result.err


def test_rights_that_are_lacking(monkeypatch, run):
    place = RemotePlace("memory://nowhere/out")

    def denied(*_, **__):
        raise PermissionError("Access Denied")

    monkeypatch.setattr(type(place._files), "pipe_file", denied)
    with pytest.raises(MachineError, match="expected to read and write memory://nowhere/out, got PermissionError: Acc"):
        generate(run, 4, "memory://nowhere/out")


def test_a_missing_package_is_named(monkeypatch):
    def missing(*_, **__):
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr("fsspec.core.url_to_fs", missing)
    with pytest.raises(ProbsceneError, match=r"pip install 'probscene\[s3\]'"):
        RemotePlace("s3://bucket/out")


def test_nothing_is_left_of_the_work(run, bucket):
    generate(run, 70, f"{bucket}/out", seed=3, format="webdataset")
    assert not [name for name in there(f"{bucket}/out") if name.startswith(PARTS)]
    assert os.environ["AWS_ENDPOINT_URL"]
