"""Whether data sets of many images can be made and read: time, memory, and every label.

    python benchmarks/many_images.py [--out FOLDER] [--images 30000] [--workers 2] [--formats webdataset coco]

A Multi-MNIST run, whose fit is as short as can be, generates the images in each format, by the command line. It is
interrupted once, at a third, and given again. Printed are hours in all; megabytes of all its processes together
(proportional set sizes): the most, and the most in the first and in the last tenth of the second command; and the
entries of the largest folder. Then all is read back: shards by the package webdataset, ``annotations.json`` by
pycocotools, images by OpenCV. Every image has to be there, and as many labels in one format as in the other.
"""

import argparse
import contextlib
import json
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import psutil
import webdataset
from given import command, out_option
from pycocotools.coco import COCO

import probscene as ps
from probscene.app.files import write_json

SHORT = {
    "features": "count",
    "parameters": "none",
    "features.schedule.steps": 60,
    "structure.batches": 2,
    "structure.num_scenes": 100,
    "pretrain.derivations": 500,
}
MEGA = 2**20


def memory(process: psutil.Process) -> float:
    """Megabytes of a process and its children, as many as have not ended meanwhile."""
    found, each = 0.0, [process]
    with contextlib.suppress(psutil.Error):
        each += process.children(recursive=True)
    for one in each:
        with contextlib.suppress(psutil.Error):
            found += one.memory_full_info().pss / MEGA
    return found


def watched(words: list[str], stop_at: Path | None = None) -> tuple[float, list[float], int]:
    """Seconds of a command, its memory over time, and how it ended; interrupted when a file is there."""
    began, seen = time.monotonic(), []
    running = psutil.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while running.poll() is None:
        if stop_at is not None and stop_at.exists():
            running.send_signal(signal.SIGINT)
            running.wait()
        if time.monotonic() - began >= len(seen):  # once a second: it takes long on a machine that is busy
            seen.append(memory(running))
        time.sleep(0.05)
    return time.monotonic() - began, seen, running.returncode


def read_shards(out: Path) -> tuple[int, int]:
    """Images and labels of all shards."""
    images = labels = 0
    shards = sorted(map(str, out.glob("shard-*.tar")))
    for sample in webdataset.WebDataset(shards, shardshuffle=False, empty_check=False):
        label = json.loads(sample["json"])
        picture = cv2.imdecode(np.frombuffer(sample["png"], np.uint8), cv2.IMREAD_UNCHANGED)
        assert picture.shape[:2] == (label["height"], label["width"]) and sample["__key__"] == f"{images:06d}"
        images, labels = images + 1, labels + len(label["annotations"])
    return images, labels


def read_coco(out: Path) -> tuple[int, int]:
    """Images and labels of ``annotations.json``."""
    coco = COCO(str(out / "annotations.json"))
    of_image = Counter(label["image_id"] for label in coco.anns.values())
    assert set(of_image) <= set(coco.imgs) and len(coco.imgs) == 1 + max(coco.imgs)
    for image in coco.imgs.values():
        picture = cv2.imread(str(out / "images" / image["file_name"]), cv2.IMREAD_UNCHANGED)
        assert picture.shape[:2] == (image["height"], image["width"])
    return len(coco.imgs), len(coco.anns)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--images", type=int, default=30_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--formats", nargs="+", choices=("webdataset", "coco"), default=["webdataset", "coco"])
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # in a shell's background it is ignored, by children too
    target, path, rows = args.out / "target", args.out / "run", []
    ps.generate(ps.load_model("multi_mnist").target(0), 200, target, format="images", progress=False)
    shutil.rmtree(path, ignore_errors=True)
    config, execution = ps.preset("quick").set(SHORT), ps.Execution(progress=False)
    ps.fit("multi_mnist", target / "images", config, out=path, execution=execution)
    for format in args.formats:
        out = args.out / format
        shutil.rmtree(out, ignore_errors=True)
        words = [sys.executable, "-m", "probscene", "generate", str(path), "--num", str(args.images)]
        words += ["--out", str(out), "--format", format, "--workers", str(args.workers)]
        third = out / ".parts" / f"{args.images // 64 // 3:06d}.json"
        first, before, ended = watched(words, third)
        assert ended == 1, f"it was to be interrupted, and ended with {ended}"
        assert not (out / "provenance.jsonl").exists(), "it was interrupted too late"
        second, after, ended = watched(words)
        assert ended == 0, f"it was to finish, and ended with {ended}"
        tenth = max(1, len(after) // 10)
        with open(out / "provenance.jsonl", encoding="utf-8") as file:
            lines = sum(1 for _ in file)
        images, labels = read_shards(out) if format == "webdataset" else read_coco(out)
        assert images == lines == args.images and all(labels == row["labels"] for row in rows)
        folders = Counter(file.parent for file in out.rglob("*"))
        row = {"format": format, "images": images, "labels": labels, "hours": (first + second) / 3600}
        row |= {"memory": max(before + after), "memory at first": max(after[:tenth]), "at last": max(after[-tenth:])}
        row |= {
            "largest folder": max(folders.values()),
            "gigabytes": sum(f.stat().st_size for f in out.rglob("*")) / 1e9,
        }
        rows.append(row)
        print(json.dumps(row), flush=True)
        write_json(args.out / "results.json", {"command": command(__file__), "rows": rows})
        shutil.rmtree(out)


if __name__ == "__main__":
    main()
