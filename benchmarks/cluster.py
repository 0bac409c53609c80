"""What a Ray cluster costs, and what a node costs that dies or freezes.

    python benchmarks/cluster.py [--out FOLDER] [--images 20000] [--repeats 1] [--disturbed 6000]

First one process, two workers and ``--cluster auto`` make the same Multi-MNIST images, in turn, once or several times:
seconds, and seconds of CPU of all processes, those of Ray among them; and what workers and a cluster cost with a chunk
for each. ``more`` is by how much the CPU of a cluster exceeds that of two workers, each without its start, each time.
Then three simulated nodes of one core each make fewer images, undisturbed, and with a node killed after a quarter and
another frozen after a half: seconds, and how long the longest wait between two chunks was. A fit's structure is learnt
on the same nodes, disturbed likewise. Whatever was disturbed is compared with the bytes of one process. Digits are
those that come with the install.
"""

import argparse
import contextlib
import filecmp
import json
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import psutil
from given import command, out_option
from simulated_cluster import Simulated

import probscene as ps
from probscene.app.chunks import CHUNK
from probscene.app.datasets.generate import generate
from probscene.app.files import write_json
from probscene.app.fitting.run import RunFolder
from probscene.app.workers.actor_pool import ActorPool
from probscene.app.workers.cluster import Cluster

SHORT = {
    "features": "count",
    "parameters": "none",
    "features.schedule.steps": 60,
    "structure.batches": 8,
    "structure.num_scenes": 300,
    "pretrain.derivations": 500,
}


class CPU:
    """Seconds of CPU of this process and of all that it has started."""

    def __enter__(self):
        self.seen: dict[int, float] = {}
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._watch, daemon=True)
        self.begun, self.before = time.monotonic(), self._own()
        self.thread.start()
        return self

    def __exit__(self, *_):
        self._look()
        self.ended.set()
        self.thread.join()
        self.wall = time.monotonic() - self.begun
        self.seconds = self._own() - self.before + sum(self.seen.values())

    def _own(self) -> float:
        return sum(psutil.Process().cpu_times()[:2])

    def _look(self) -> None:
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):
                self.seen[process.pid] = sum(process.cpu_times()[:2])

    def _watch(self) -> None:
        while not self.ended.wait(0.5):
            self._look()


def same(one: Path, other: Path) -> bool:
    """Whether two folders hold the same files."""
    files = [{path.relative_to(folder) for path in folder.rglob("*") if path.is_file()} for folder in (one, other)]
    return files[0] == files[1] and not filecmp.cmpfiles(one, other, files[0], shallow=False)[1]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--images", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--disturbed", type=int, default=6_000)
    args = parser.parse_args()
    out, found = args.out, {"command": command(__file__)}
    model = ps.load_model("multi_mnist")
    target = out / "target"
    ps.generate(model.target(0), 300, target, format="images", progress=False)
    shutil.rmtree(out / "alone", ignore_errors=True)
    config, alone_by = ps.preset("quick").set(SHORT), ps.Execution(threads=1, cache=out / "cache")
    alone = ps.fit("multi_mnist", target / "images", config, out=out / "alone", execution=alone_by)
    run = RunFolder.at(alone.path)

    def made(name, number, **how):
        shutil.rmtree(out / name, ignore_errors=True)
        with CPU() as cost:
            if how.pop("auto", False):
                with Cluster("auto") as cluster:
                    generate(run, number, out / name, 0, workers=cluster)
            else:
                generate(run, number, out / name, 0, **how)
        found.setdefault(name, []).append({"images": number, "seconds": cost.wall, "cpu": cost.seconds})
        print(name, json.dumps(found[name][-1]), flush=True)
        return cost.seconds

    more = []
    for _ in range(args.repeats if args.images else 0):
        start = [made("two workers' start", 2 * CHUNK, workers=2), made("a cluster's start", 2 * CHUNK, auto=True)]
        made("one process", args.images)
        whole = [made("two workers", args.images, workers=2), made("cluster", args.images, auto=True)]
        workers, cluster = (all - some for all, some in zip(whole, start, strict=True))
        more.append(cluster / workers - 1)
        found["same bytes"] = found.get("same bytes", True) and same(out / "one process", out / "cluster")
    found["more"] = more
    print("more", *(f"{part:.1%}" for part in more), flush=True)
    made("fewer", args.disturbed)
    simulated = Simulated()
    for name, disturb in (("three nodes", False), ("one killed, one frozen", True)):
        simulated.whole()
        shutil.rmtree(out / name, ignore_errors=True)
        times, said, done = [time.monotonic()], [], set()

        def progress(number, total, disturb=disturb, times=times, done=done):
            times.append(time.monotonic())
            for share, what in ((4, simulated.kill), (2, simulated.freeze)):
                if disturb and number >= total // share and what not in done:
                    done.add(what)
                    what()

        with Cluster(simulated.address, said.append) as cluster:
            generate(run, args.disturbed, out / name, 0, progress=progress, workers=cluster)
        longest = max(later - earlier for earlier, later in zip(times, times[1:], strict=False))
        found[name] = {"images": args.disturbed, "seconds": times[-1] - times[0], "longest wait": longest}
        found[name] |= {"same bytes": same(out / "fewer", out / name), "said": said}
        print(name, json.dumps(found[name]), flush=True)
    simulated.whole()
    shutil.rmtree(out / "nodes", ignore_errors=True)
    run_pool, parts = ActorPool.run, []

    def disturbed(pool, tasks, done):
        def each(result):
            parts.append(result)
            for number, what in ((8, simulated.kill), (20, simulated.freeze)):
                if len(parts) == number:
                    what()
            done(result)

        run_pool(pool, tasks, each)

    ActorPool.run = disturbed
    with CPU() as cost:
        by_nodes = replace(alone_by, cluster=simulated.address)
        ps.fit("multi_mnist", target / "images", config, out=out / "nodes", execution=by_nodes)
    guides = [(out / name / "guide.safetensors").read_bytes() for name in ("alone", "nodes")]
    found["fit"] = {"seconds": cost.wall, "same bytes": guides[0] == guides[1]}
    print("fit", json.dumps(found["fit"]), flush=True)
    simulated.shutdown()
    write_json(out / "results.json", found)


if __name__ == "__main__":
    main()
