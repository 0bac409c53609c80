"""Whether restarts keep a generator's memory within its limit, and leave its pictures as they are.

    python benchmarks/generator_memory.py [--out FOLDER] [--scenes 300] [--memory 500]

Blender draws the table of ``examples/generators/blender`` with new meshes and materials for each object, which it keeps
(``make blender`` makes its environment). The same scenes are drawn by one worker that is never restarted, by two that
are where they hold more than so many megabytes, and by one that is after every 40 scenes. Printed for each: the largest
memory of a worker, how many there were, seconds, and whether the bytes of images and ids are those of the first.
"""

import argparse
import json
import threading
import time
from dataclasses import replace
from pathlib import Path

import psutil
import torch
from given import command, needed, out_option

from probscene.app.files import write_json
from probscene.app.loading import load_model
from probscene.renderers.generator.pool import close_pools, pool_for
from probscene.renderers.generator.renderer import GeneratedRenderer
from probscene.sampling import sample, seed_everything

MODEL = Path(__file__).parents[1] / "examples" / "generators" / "blender" / "table.py"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--memory", type=float, default=500.0)
    args = parser.parse_args()
    model = load_model(str(MODEL))
    python = Path(model.generator.argv[0])
    needed(python if python.exists() else None, "Blender's environment by make blender")
    seed_everything(0)
    scenes, first, rows = sample(model, model.prior, args.scenes).drawing, None, []
    leaking = replace(
        model.generator,
        argv=(model.generator.argv[0], str(Path(__file__).with_name("leaking_studio.py"))),
        files=(str(MODEL.with_name("draw.py")),),
        memory=None,
    )
    ways = {
        "never restarted": replace(leaking, workers=1),
        f"restarted above {args.memory:g} MB": replace(leaking, workers=2, memory=args.memory),
        "restarted after 40 scenes": replace(leaking, workers=1, restart_after=40),
    }
    for name, way in ways.items():
        largest: dict[int, float] = {}
        ended = threading.Event()

        def look(way=way, largest=largest, ended=ended):
            while not ended.wait(0.05):
                for pid in pool_for(way, 1).processes():
                    try:
                        largest[pid] = max(largest.get(pid, 0.0), psutil.Process(pid).memory_info().rss / 2**20)
                    except psutil.Error:
                        continue

        watching, begun = threading.Thread(target=look, daemon=True), time.monotonic()
        watching.start()
        batch = GeneratedRenderer(way, model.canvas)(scenes)
        seconds = time.monotonic() - begun
        ended.set()
        watching.join()
        close_pools()
        first = first or batch
        same = torch.equal(batch.image, first.image) and torch.equal(batch.instance, first.instance)
        rows.append({"way": name, "megabytes": max(largest.values()), "processes": len(largest)})
        rows[-1] |= {"seconds": seconds, "same bytes": same}
        print(json.dumps(rows[-1]), flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(args.out / "results.json", {"command": command(__file__), "scenes": args.scenes, "rows": rows})


if __name__ == "__main__":
    main()
