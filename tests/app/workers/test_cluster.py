"""A Ray cluster makes what one process makes, whatever becomes of its nodes."""

import errno
import os
import socket
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from probscene.app.api.fit import fit
from probscene.app.datasets import generate as datasets
from probscene.app.datasets.generate import DatasetOptions, _actor, generate, workers_or_cluster
from probscene.app.fitting.pipeline import Execution
from probscene.app.fitting.run import RunFolder
from probscene.app.workers import actor_pool
from probscene.app.workers import cluster as clusters
from probscene.app.workers.cluster import Cluster
from probscene.errors import MachineError, ModelError, ProbsceneError

from .tasks import doubling, drawing, slow

pytest.importorskip("ray")
pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own


def unwritable(node, tried, *arguments):
    """The work of ``generate``, where one node's disk takes no files; others leave it chunks until it has tried."""
    import ray

    def fails(*_):
        tried.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def waits(chunk):
        while chunk and not tried.exists():
            time.sleep(0.05)
        return make(chunk)

    make = _actor(*arguments)
    if ray.get_runtime_context().get_node_id() != node:
        return waits
    os.replace = fails
    return make


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def messages():
    return []


@pytest.fixture
def nodes(simulated, messages, monkeypatch):
    """A connection to the cluster; what is late is soon found to be."""
    monkeypatch.setattr(actor_pool, "MIN_LATE_SECONDS", 2.0)
    with Cluster(simulated.address, messages.append) as connected:
        yield connected


@pytest.fixture(scope="module")
def alone(fitted, tmp_path_factory) -> dict[str, bytes]:
    """What one process makes of 400 images."""
    out = tmp_path_factory.mktemp("alone") / "out"
    generate(RunFolder.at(fitted), 400, out, seed=3, format="coco,yolo")
    return contents(out)


def test_each_task_is_done_once_though_nodes_die_and_freeze(simulated, nodes, messages):
    simulated.whole(3)
    pool, found = nodes.actor_pool(doubling, (0.1,)), []
    while sum(isinstance(member.request, int) for member in pool._members) < 3:  # until every node is at work
        pool.run(range(3), lambda result: None)

    def done(result):
        found.append(result)
        if len(found) == 6:
            simulated.kill()
        if len(found) == 12:
            simulated.freeze()

    pool.run(range(40), done)
    assert sorted(found) == [(task, 2 * task) for task in range(40)]
    end = time.monotonic() + 120
    while len(pool._names) == 3:  # Ray needs some seconds to see that one is lost
        again = []
        pool.run([7, 8], again.append)  # on the node that is left
        assert sorted(again) == [(7, 14), (8, 16)] and time.monotonic() < end
    told = [line for line in messages if "is lost" in line or "has not answered" in line]
    assert len(told) == 2 and sum("has not answered" in line for line in told) >= 1  # on a busy machine both are late
    pool.close()


def test_a_dataset_has_the_bytes_of_one_process(simulated, nodes, fitted, alone, tmp_path):
    simulated.whole(3)
    run, made = RunFolder.at(fitted), []

    def progress(number, _):
        made.append(number)
        if len(made) == 3:
            simulated.kill()
        if len(made) == 5:
            simulated.freeze()

    dataset = generate(run, 400, tmp_path / "out", 3, format="coco,yolo", progress=progress, workers=nodes)
    assert dataset.made == 400 and dataset.finished and made[-1] == 400
    assert contents(tmp_path / "out") == alone


def test_a_fit_has_the_bytes_of_one_process(simulated, call, discs, target, tmp_path, monkeypatch):
    simulated.whole(2)
    words = ["fit", discs.file, "--target", target.images, *discs.settings, "--set", "structure.num_scenes=150"]
    assert call(*words, "--out", tmp_path / "alone").code == 0
    parts, run = [], actor_pool.ActorPool.run

    def disturbed(pool, tasks, done):
        def each(result):
            parts.append(result)
            if len(parts) == 4:
                simulated.kill()
            done(result)

        return run(pool, tasks, each)

    monkeypatch.setattr(actor_pool, "MIN_LATE_SECONDS", 2.0)
    monkeypatch.setattr(actor_pool.ActorPool, "run", disturbed)
    result = call(*words, "--out", tmp_path / "out", "--cluster", simulated.address)
    assert result.code == 0, result.err
    assert len(parts) == 4 * 3
    for name in ("features.safetensors", "guide.safetensors", "log.jsonl"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name


def test_an_actor_that_prepares_itself_for_long_is_waited_for(nodes, monkeypatch):
    pool, found = nodes.actor_pool(slow, ()), []
    monkeypatch.setattr(actor_pool, "START_TIMEOUT", 0.0)
    while not pool.any_answered():  # this has no actor yet
        with suppress(MachineError):
            pool.run([1], lambda result: None)
    pool.run([1, 2], found.append)
    assert sorted(found) == [(1, 2), (2, 4)]


def test_generators_that_nodes_have_started_leave_no_files(nodes):
    argv = [sys.executable, str(Path(__file__).parents[1] / "generators" / "draw_boxes.py")]
    pool, folders = nodes.actor_pool(drawing, (argv,)), []
    pool.run([0], folders.append)
    (folder,) = folders
    assert os.path.exists(folder)
    pool.close()
    assert not os.path.exists(folder)


def test_what_a_task_raises_is_told_with_its_node(nodes):
    with pytest.raises(ModelError, match="^On node .*: this one cannot be drawn$"):
        nodes.actor_pool(doubling, (0.0, 3)).run([3], lambda result: None)


def test_a_disk_that_takes_no_files_on_one_node(simulated, nodes, fitted, alone, tmp_path, monkeypatch):
    simulated.whole(2)
    run, node, out = RunFolder.at(fitted), simulated.nodes[1].node_id, tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(datasets, "_actor", partial(unwritable, node, tmp_path / "tried"))
        with pytest.raises(MachineError, match="On node .*: .*The disk is full"):
            generate(run, 400, out, seed=3, format="coco,yolo", workers=nodes)
    shown = {name: data for name, data in contents(out).items() if not name.startswith(".")}
    assert shown.items() <= alone.items()  # whole or absent
    generate(run, 400, out, seed=3, format="coco,yolo", workers=nodes)
    assert contents(out) == alone


def test_other_versions_are_refused(nodes, monkeypatch):
    here = actor_pool.versions()
    monkeypatch.setattr(actor_pool, "versions", lambda: {**here, "torch": "1.0"})
    with pytest.raises(ProbsceneError, match="expected torch 1.0 on node .*, as on this machine, got 2"):
        nodes.actor_pool(doubling, ()).run([1], lambda result: None)


def test_an_engine_that_a_node_lacks_is_its_answer(monkeypatch):
    monkeypatch.setenv("PROBSCENE_ENGINE", "none")
    kind, error = actor_pool.Actor().versions()
    assert kind == "fault" and isinstance(error, ProbsceneError)


def test_the_last_node_is_lost(simulated, nodes):
    while len(simulated.nodes) > 1:
        simulated.kill()

    def done(_):
        while simulated.nodes:
            simulated.kill()

    with pytest.raises(MachineError, match="expected a node with 1 cores .*, got .*continues where it stopped"):
        nodes.actor_pool(doubling, (0.1,)).run(range(1000), done)


def test_a_folder_that_nodes_do_not_see_is_named(nodes, fitted, tmp_path):
    run = RunFolder.at(fitted)
    assert run.guide_hash() and run.guide  # as of another machine's disk, which nodes do not have
    run.path = tmp_path / "elsewhere"
    with pytest.raises(ProbsceneError, match="On node .*: expected a run folder .*elsewhere.*by the same paths"):
        arguments = run.path, 10, tmp_path / "out", 0, ("coco",), DatasetOptions()
        nodes.actor_pool(_actor, arguments).run([0], lambda result: None)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "nowhere", "nowhere.invalid:6379"])
def test_a_cluster_that_is_not_there_is_one_line(call, fitted, tmp_path, address):
    result = call("generate", fitted, "--num", 4, "--out", tmp_path / "out", "--cluster", address)
    assert result.code == 1 and result.err.count("\n") == 1
    assert f"expected a Ray cluster at {address}, got none" in result.err and not (tmp_path / "out").exists()


def test_a_fit_without_its_cluster_leaves_no_run(call, discs, target, tmp_path):
    result = call("fit", discs.file, "--target", target.images, "--out", tmp_path / "out", "--cluster", "127.0.0.1:1")
    assert result.code == 1 and result.err.count("\n") == 1
    assert "expected a Ray cluster at 127.0.0.1:1" in result.err and not (tmp_path / "out").exists()
    with pytest.raises(MachineError, match="expected a Ray cluster at 127.0.0.1:1"):
        fit(discs.file, target.images, out=tmp_path / "out", execution=Execution(cluster="127.0.0.1:1", progress=False))
    assert not (tmp_path / "out").exists()


def test_what_is_not_ray_is_told_in_time(call, fitted, tmp_path, monkeypatch):
    monkeypatch.setattr(clusters, "ANSWER_TIMEOUT", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        address = f"127.0.0.1:{listening.getsockname()[1]}"
        result = call("generate", fitted, "--num", 4, "--out", tmp_path / "out", "--cluster", address)
    assert result.code == 1 and result.err.count("\n") == 1
    assert f"expected a Ray cluster at {address}, got none (something that is not Ray listens there" in result.err


def test_another_version_of_ray_is_no_missing_cluster(monkeypatch):
    def mismatched(**_):
        there = "The cluster was started with:\n    Ray: 2.1.0\n    Python: 3.9.1\n"
        here = "This process on 10.0.0.2 was started with:\n    Ray: 2.60.0\n    Python: 3.11.9\n"
        raise RuntimeError(f"Version mismatch: {there}{here}")

    monkeypatch.setattr("ray.init", mismatched)
    monkeypatch.setattr(clusters, "_checked_address", lambda address: address)
    with pytest.raises(MachineError, match="got Ray 2.1.0 and Python 3.9.1; install the same versions"):
        Cluster("10.0.0.1:6379")


def test_auto_starts_one_where_what_ray_remembers_is_gone(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    found = []
    with Cluster("auto") as cluster:
        cluster.actor_pool(doubling, ()).run([1], found.append)
    assert found == [(1, 2)]


def test_workers_or_a_cluster(nodes):
    assert workers_or_cluster(2, None) == 2 and workers_or_cluster(1, nodes) is nodes
    with pytest.raises(ProbsceneError, match="expected workers or a cluster"):
        workers_or_cluster(2, nodes)
