"""Where a fit's time and memory go: seconds of each stage by what they are spent on.

    python benchmarks/profile_fit.py MODEL [IMAGES] [--preset quick] [--set key=value] [--threads 1] [--out FOLDER]

A sampler looks a hundred times a second at what each thread does. Its innermost frame that is one of ours, or a
renderer's, says what that is spent on: rendering, the model's program with Pyro, networks and their training, guides
and derivations, comparing features, reading files, waiting for a thread, or other. Printed are seconds of the main
thread, and of other threads without their waiting, in percent of the stage; and the process's largest memory. Without
IMAGES, 2,000 are drawn of the model's own target.
"""

import argparse
import resource
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from types import FrameType

from given import out_option

import probscene as ps
from probscene.app.files import write_json

EVERY = 0.01  # seconds
STAGES = {
    "finish": "network", "_real_features": "target", "learn_structure": "structure", "learn_parameters": "parameters",
    "refine_structure": "refinement", "conclude": "outcome",
}  # fmt: skip
"""Of functions of ``fitting.pipeline`` and its stages."""
SPENT_ON = (
    ("rendering", ("/renderers/", "/taichi/", "/quadrants/")),
    ("reading files", ("/probscene/dataset.py", "/probscene/decoding.py", "/probscene/image_")),
    ("comparing", ("/inference/divergence.py", "/inference/statistics/")),
    ("networks", ("/inference/features/", "/parameters/reader", "/parameters/backbone", "/parameters/global_head",
                  "/inference/training.py", "/torchvision/", "/efficientnet_lite_pytorch/")),
    ("guides", ("/inference/guides/", "/inference/parameters/", "/inference/objective.py", "/inference/pretrain.py",
                "/inference/structure_training.py",
                "/inference/render_cache.py",
                "/probscene/deriv", "/probscene/structure.py", "/probscene/branching.py", "/probscene/lists.py")),
    ("program", ("/models/", "/pyro/", "/probscene/sampling.py", "/probscene/scene.py", "/probscene/drawing.py",
                 "/probscene/world.py", "/probscene/model.py", "/examples/")),
    ("waiting", ("/threading.py", "/concurrent/futures/", "/queue.py")),
)  # fmt: skip
"""By parts of a file's path, the first that fits."""


class Sampler(threading.Thread):
    """Looks at all threads until it is stopped.

    Attributes:
        seen: samples by stage, by what they were spent on, and by whether they were of the main thread.
    """

    def __init__(self):
        super().__init__(daemon=True)
        self.seen: Counter[tuple[str, str, bool]] = Counter()
        self.main, self.over = threading.main_thread().ident, False

    def run(self) -> None:
        """See ``Thread``."""
        while not self.over:
            frames = sys._current_frames()
            stage = stage_of(frames[self.main]) if self.main in frames else "other"
            for thread, frame in frames.items():
                if thread != self.ident:
                    self.seen[stage, spent_on(frame), thread == self.main] += 1
            time.sleep(EVERY)


def stage_of(frame: FrameType | None) -> str:
    """The stage of the outermost frame that names one."""
    found = "beginning"
    while frame is not None:
        if "/fitting/" in frame.f_code.co_filename:
            found = STAGES.get(frame.f_code.co_name, found)
        frame = frame.f_back
    return found


def spent_on(frame: FrameType | None) -> str:
    """What the innermost frame of ours is."""
    while frame is not None:
        for name, parts in SPENT_ON:
            if any(part in frame.f_code.co_filename for part in parts):
                return name
        frame = frame.f_back
    return "other"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("model")
    parser.add_argument("images", nargs="?", type=Path)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--set", action="append", default=[], help="as of probscene fit")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    name = Path(args.model).stem
    if args.images is None:
        target = ps.load_model(args.model).target
        assert target is not None, "a model without a target of its own needs IMAGES"
        args.images = ps.generate(target(args.seed), 2000, args.out / name / "target", format="images").path / "images"
    sampler, began, cpu = Sampler(), time.monotonic(), time.process_time()
    sampler.start()
    execution = ps.Execution(args.threads, cache=False)
    out = args.out / name / f"run-{args.threads}"
    ps.fit(args.model, args.images, ps.preset(args.preset).set(*args.set), out=out, seed=args.seed, execution=execution)
    sampler.over = True
    sampler.join()
    wall, cpu = time.monotonic() - began, time.process_time() - cpu
    scale = wall / sum(number for (_, _, main), number in sampler.seen.items() if main)
    columns, rows = [*(name for name, _ in SPENT_ON), "other", "beside"], {}
    for (stage, what, main), number in sampler.seen.items():
        row = rows.setdefault(stage, dict.fromkeys(["seconds", *columns], 0.0))
        if main:
            row["seconds"] += scale * number
            row[what] += scale * number
        elif what not in ("waiting", "other"):
            row["beside"] += scale * number
    print("| stage | seconds |" + "".join(f" {name} |" for name in columns))
    print("|---" * (2 + len(columns)) + "|")
    for stage, row in sorted(rows.items(), key=lambda pair: -pair[1]["seconds"]):
        shares = (f"{row[column] / max(row['seconds'], 1e-9):.0%}" for column in columns)
        print(f"| {stage} | {row['seconds']:.0f} |" + "".join(f" {share} |" for share in shares))
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{wall:.0f} seconds, {cpu:.0f} of CPU, {megabytes:.0f} MB at most, {args.threads} threads of torch")
    write_json(out / "profile.json", {"rows": rows, "wall": wall, "cpu": cpu, "megabytes": megabytes})


if __name__ == "__main__":
    main()
