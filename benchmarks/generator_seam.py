"""What the way to a generator in another process costs, beside a function in this process and a pipe of one's own.

    python benchmarks/generator_seam.py [--images 300] [--size 256]

The program draws nothing: it gives the same colours and ids each time. Printed are milliseconds of wall time an image
for one worker, and each way's ratio to a ``multiprocessing`` connection that pickles the same arrays, which is what one
would write without probscene and which checks nothing, kills nothing and tries nothing again. Boxes and pixels are
counted from the ids in all but that row.
"""

import argparse
import multiprocessing
import os
import sys
import time
from multiprocessing.connection import Connection

import numpy as np
import torch

from probscene.generator import Command
from probscene.renderers.generator.renderer import GeneratedRenderer
from probscene.request import Request

NODES, ROUNDS = 12, 3


def picture(size: int) -> dict[str, np.ndarray]:
    """Colours and ids of a grid of squares."""
    rng = np.random.default_rng(0)
    ids = np.zeros((size, size), np.uint16)
    side = size // 8
    for node in range(NODES):
        row, column = divmod(node, 4)
        ids[2 * side * row : 2 * side * row + side, 2 * side * column : 2 * side * column + side] = node + 1
    return {"image": rng.integers(0, 256, (size, size, 3), np.uint8), "instance": ids}


def piped(wire: Connection, size: int) -> None:
    """The other end of a pipe of one's own."""
    drawn = picture(size)
    while wire.recv() is not None:
        wire.send(drawn)


def request(images: int) -> Request:
    """Scenes of as many nodes as the picture shows."""
    kind = torch.zeros(images, NODES, dtype=torch.int64)
    return Request(kind, ("thing",), torch.full_like(kind, -1), torch.arange(images), (), ())


def timed(draw, images: int) -> float:
    """Milliseconds an image, the least of several rounds."""
    draw(2)
    found = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        draw(images)
        found.append((time.perf_counter() - start) / images)
    return 1000 * min(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--size", type=int, default=256)
    args = parser.parse_args()
    canvas, drawn = (args.size, args.size), picture(args.size)
    command = Command([sys.executable, os.path.abspath(__file__), str(args.size)], workers=1)
    outside, inside = GeneratedRenderer(command, canvas, 1), GeneratedRenderer(lambda scene: drawn, canvas, 1)
    here, there = multiprocessing.Pipe()
    other = multiprocessing.get_context("spawn").Process(target=piped, args=(there, args.size), daemon=True)
    other.start()

    def by_pipe(images: int) -> None:
        for record in request(images).records(canvas):
            here.send(record)
            here.recv()

    rows = {
        "a pipe of one's own": timed(by_pipe, args.images),
        "a function in this process": timed(lambda images: inside(request(images)), args.images),
        "a Command": timed(lambda images: outside(request(images)), args.images),
    }
    here.send(None)
    first = rows["a pipe of one's own"]
    for name, found in rows.items():
        print(f"{name:30}{found:8.2f} ms{found / first:8.2f}")


if __name__ == "__main__":
    if "PROBSCENE_WORKER" in os.environ:
        sys.path.insert(0, os.environ["PROBSCENE_WORKER"])
        from probscene_worker import serve

        drawn = picture(int(sys.argv[1]))
        serve(lambda scene: drawn)
    else:
        main()
