"""Scenes that other processes draw: the bytes of an undisturbed run whatever happens, or one clear error."""

import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from probscene.errors import GeneratorError, MachineError
from probscene.generator import Command
from probscene.renderers.generator.pool import pool_for
from probscene.renderers.generator.renderer import GeneratedRenderer

SCENES = 24


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("crash", {}), ("exit", {}), ("raise", {}), ("garbage", {}), ("noise", {}), ("hang", {"timeout": 1.5}),
        ("leak", {"memory": 60.0}), ("", {"restart_after": 5}), ("", {"workers": 1}), ("", {"workers": 5}),
    ],
)  # fmt: skip
def test_the_bytes_are_those_of_an_undisturbed_run(  # noqa: PLR0913 - fixtures and parameters
    drawn, request_of, fault, fresh, running, command, same, name, settings
):
    request = request_of(SCENES)
    assert (request.seed % 3 == 0).sum() > 3  # those are disturbed
    undisturbed = drawn(request)
    fresh()
    fault(name)
    assert same(drawn(request, **settings), undisturbed)
    workers = pool_for(command(**settings), 2).processes()
    assert workers or name == "leak"
    fresh()
    assert not any(running(group) for group in workers)


def test_only_a_worker_that_holds_much_memory_is_replaced(drawn, request_of, fault, fresh, command):
    request = request_of(SCENES)
    pool = pool_for(command(memory=60.0), 2)  # this process has far more
    drawn(request, memory=60.0)
    workers = set(pool.processes())
    drawn(request, memory=60.0)
    assert len(workers) == 2 and set(pool.processes()) == workers
    fresh()
    fault("leak")
    pool, seen = pool_for(command(memory=60.0), 2), set()
    for i in range(SCENES):
        drawn(request[i : i + 1], memory=60.0)
        seen |= set(pool.processes())
    assert len(seen) > 2


def test_a_scene_does_not_depend_on_its_batch(drawn, request_of):
    request = request_of(SCENES)
    whole = drawn(request)
    for some in (slice(0, 1), slice(7, 12)):
        part = drawn(request[some])
        assert torch.equal(part.image, whole.image[some]) and torch.equal(part.instance, whole.instance[some])


def test_what_a_killed_worker_has_started_is_killed_with_it(drawn, request_of, fault, command, running):
    fault("hang")
    groups, request = set(), request_of(6)
    drawing = threading.Thread(target=drawn, args=(request,), kwargs={"timeout": 2.0})
    drawing.start()
    while drawing.is_alive():
        groups |= set(pool_for(command(timeout=2.0), 2).processes())
        time.sleep(0.05)
    left = set(pool_for(command(timeout=2.0), 2).processes())
    assert groups - left and not any(running(group) for group in groups - left)


def test_a_worker_that_is_killed_from_outside_is_replaced(drawn, request_of, command, fresh, same):
    request = request_of(SCENES)
    whole = drawn(request)
    for group in pool_for(command(), 2).processes():
        os.killpg(group, signal.SIGKILL)
    assert same(drawn(request), whole)


def test_workers_are_shared_and_as_many_as_are_asked_for(drawn, request_of, command):
    drawn(request_of(SCENES))
    first = pool_for(command(), 1).processes()
    drawn(request_of(SCENES, seed=1))
    assert 1 <= len(first) <= 2 and pool_for(command(), 1).processes() == first


def test_without_unix_sockets_the_bytes_are_the_same(drawn, request_of, fresh, command, tmp_path, monkeypatch, same):
    """In any folder, however long its path."""
    request = request_of(SCENES)
    whole = drawn(request)
    fresh()
    monkeypatch.delattr(socket, "AF_UNIX")
    monkeypatch.delattr(os, "killpg")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / ("long" * 20)))
    Path(tempfile.tempdir).mkdir()
    assert same(drawn(request, restart_after=7), whole)
    assert pool_for(command(restart_after=7), 1).folder.parent == Path(tempfile.tempdir)


def test_several_threads_draw_at_once(drawn, request_of, same):
    requests = [request_of(8, seed=s) for s in range(4)]
    expected, found = [drawn(request) for request in requests], {}
    threads = [threading.Thread(target=lambda i=i: found.update({i: drawn(requests[i])})) for i in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert all(same(found[i], expected[i]) for i in range(4))


def test_a_scene_that_always_fails_is_named_with_what_was_raised_and_printed(drawn, request_of, fault):
    fault("always")
    with pytest.raises(GeneratorError, match="draw_boxes.py to draw the scene of seed") as error:
        drawn(request_of(1), attempts=2)
    assert all(x in str(error.value) for x in ("in 2 attempts", "never any mesh", "draw_boxes.py", "drawing", "plate"))


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("gone", {"attempts": 1}, "serve; run its argv by hand\nThe end of what it printed:\nno licence"),
        ("silent", {"attempts": 1, "start_timeout": 1.0}, "serve 1 seconds after it was started; raise start_timeout="),
        ("hang", {"attempts": 1, "timeout": 1.0}, "nothing after 1 seconds; raise timeout= of its Command where"),
        ("garbage", {"attempts": 1}, r"expected image as uint8 \(32, 40, 3\), got uint8 \(1,\)"),
        ("crash", {"attempts": 1}, "was ended by SIGABRT"),
        ("", {"version": "2"}, "version '2' of the generator draw_boxes.py, got ''"),
    ],
)
def test_what_goes_wrong_is_said(drawn, request_of, fault, name, settings, said):
    fault(name)
    with pytest.raises(GeneratorError, match=said):
        drawn(request_of(SCENES), **settings)


def test_a_program_that_is_not_there_or_speaks_otherwise(request_of, tmp_path):
    request = request_of(1)
    with pytest.raises(GeneratorError, match="start the generator nowhere, got No such file"):
        GeneratedRenderer(Command(["/nowhere"]), (32, 40))(request)
    stranger = tmp_path / "stranger.py"
    stranger.write_text(
        "import os, socket, time\nwire = socket.socket(socket.AF_UNIX)\nwire.connect(os.environ['PROBSCENE_SOCKET'])\n"
        "wire.sendall(b'HTTP/1.1 200 OK\\r\\n\\r\\n')\ntime.sleep(60)\n"
    )
    with pytest.raises(GeneratorError, match="speak protocol 1 of probscene, got something else; let it import"):
        GeneratedRenderer(Command([sys.executable, str(stranger)]), (32, 40))(request)


@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
@pytest.mark.parametrize(
    ("end", "program"),
    [
        ("start_timeout", "silent"), ("interrupt", "silent"), ("interrupt", "hang"), ("SIGTERM", "hang"),
        ("SIGKILL", "serve"), ("SIGKILL", "silent"), ("SIGKILL", "hang"),
    ],
)  # fmt: skip
def test_all_ends_with_the_parent(end, program, command, tmp_path):
    """Also where it is killed, and has no time to end anything, and whatever the programs are doing."""
    argv = [*command().argv, str(tmp_path)]
    ending = {
        "start_timeout": "time.sleep(0)",
        "interrupt": "signal.raise_signal(signal.SIGINT)",
        "SIGTERM": "signal.raise_signal(signal.SIGTERM)",
        "SIGKILL": "signal.raise_signal(signal.SIGKILL)",
    }[end]
    code = f"""
import signal, threading, time
from probscene.generator import Command
from probscene.renderers.generator.pool import pool_for
pool = pool_for(Command({argv!r}, start_timeout={60 if end != "start_timeout" else 0.5}), 2)
scene = {{"height": 4, "width": 4, "seed": 3, "values": {{"light": 1}}, "nodes": []}}
print(pool.folder, flush=True)
drawing = threading.Thread(target=pool.draw, args=([scene] * 2,), daemon=True)
drawing.start()
drawing.join(1.5)
{ending}
"""
    environment = {**os.environ, "TEST_FAULT": program, "TEST_MARK": str(tmp_path)}
    told = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    folder, until = told.stdout.strip(), time.monotonic() + 60
    while (left := processes_with(str(tmp_path)) + processes_with(folder)) and time.monotonic() < until:
        time.sleep(0.1)
    for process in left:
        os.kill(process, signal.SIGKILL)
    assert folder and not left and not os.path.exists(folder)


def processes_with(word):
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            if word in file.read_bytes().decode(errors="replace").split("\0"):
                found.append(int(file.parent.name))
    return found


def test_a_program_starts_no_more_once_its_pool_is_closed(command, fault, running):
    fault("silent")
    pool, said = pool_for(command(), 2), []

    def draw():
        try:
            pool.draw([{"height": 4, "width": 4, "seed": 1, "values": {}, "nodes": []}] * 4)
        except GeneratorError as error:
            said.append(str(error))

    drawing = threading.Thread(target=draw)
    drawing.start()
    end = time.monotonic() + 60
    while len(groups := pool.processes()) < 2 and time.monotonic() < end:
        time.sleep(0.01)
    pool.close()
    drawing.join(60)
    assert said == ["The generator draw_boxes.py was ended while it drew."]
    assert len(groups) == 2 and not any(running(group) for group in groups)
    assert set(pool.processes()) <= set(groups)


def test_where_temporary_files_find_no_room(command):
    pool = pool_for(command(attempts=1), 0)
    shutil.rmtree(pool.folder)
    pool.grow(1)
    with pytest.raises(MachineError, match="temporary files for the generator draw_boxes.py, got .*; make room, or"):
        pool.draw([{"height": 4, "width": 4, "seed": 1, "values": {}, "nodes": []}])


def test_a_pool_is_closed_while_a_fork_of_its_process_runs(command, running):
    pool = pool_for(command(), 1)
    pool.draw([{"height": 4, "width": 4, "seed": 1, "values": {"light": 1}, "nodes": []}])
    group, fork = pool.processes()[0], os.fork()
    if fork == 0:
        time.sleep(60)
        os._exit(0)
    try:
        pool.close()
        assert not running(group) and not pool.folder.exists()
    finally:
        os.kill(fork, signal.SIGKILL)
        os.waitpid(fork, 0)


def test_a_guard_that_is_ended_changes_nothing(drawn, request_of, command, running, fresh, same):
    request = request_of(6)
    whole = drawn(request)
    fresh()
    drawn(request[:1])
    pool = pool_for(command(), 2)
    for process in processes_with(str(pool.folder)):
        os.kill(process, signal.SIGKILL)
    assert same(drawn(request, restart_after=None), whole)
    workers = pool.processes()
    fresh()
    assert not any(running(group) for group in workers)


def pool_of_a_child(argv, out):
    pool = pool_for(Command(argv), 1)
    pool.draw([{"height": 4, "width": 4, "seed": 1, "values": {}, "nodes": []}])
    out.put((pool.processes()[0], str(pool.folder)))


@pytest.mark.parametrize("method", ["forkserver", "spawn"])
def test_a_process_of_multiprocessing_leaves_nothing(method, command, running):
    context = multiprocessing.get_context(method)
    out = context.Queue()
    child = context.Process(target=pool_of_a_child, args=(command().argv, out))
    child.start()
    group, folder = out.get(timeout=300)
    child.join()
    assert child.exitcode == 0 and not running(group) and not os.path.exists(folder)
