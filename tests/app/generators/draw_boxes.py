"""A generator in plain Python: filled squares, and, asked by the environment, all that can go wrong."""

import array
import os
import random
import subprocess
import sys
import time

sys.path.insert(0, os.environ["PROBSCENE_WORKER"])
from probscene_worker import serve

FAULT = os.environ.get("TEST_FAULT", "")
MARK = os.environ.get("TEST_MARK", "")  # a folder that remembers which scene failed before
kept = []


def first_time(scene):
    """Whether this scene has not been seen by any process."""
    try:
        os.close(os.open(os.path.join(MARK, str(scene.seed)), os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def render(scene):
    print("drawing", scene.seed)
    fails = scene.seed % 3 == 0 and bool(MARK) and first_time(scene)
    if FAULT == "crash" and fails:
        os.abort()
    if FAULT == "exit" and fails:
        sys.exit(3)
    if FAULT == "hang" and fails:
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        time.sleep(600)
    if FAULT == "raise" and fails:
        raise KeyError("no such mesh")
    if FAULT == "always":
        raise KeyError("never any mesh")
    if FAULT == "leak":
        kept.append(bytearray(os.urandom(1 << 20)) * 20)
    if FAULT == "garbage" and fails:
        return {"image": b"x", "instance": b"y"}
    if FAULT == "noise":
        sys.stdout.write("noise\n" * 100_000)
    draw = random.Random(scene.seed)
    image = bytearray(draw.randrange(256) for _ in range(scene.height * scene.width * 3))
    ids = array.array("H", [0] * (scene.height * scene.width))
    boxes = {}
    for node in scene.nodes:
        x, y, size = int(node.values["x"]), int(node.values["y"]), 4 if node.kind == "plate" else 2
        boxes[node.id] = x - size - 0.4, y - size - 0.4, x + size + 0.4, y + size + 0.4
        for row in range(max(0, y - size), min(scene.height, y + size)):
            for column in range(max(0, x - size), min(scene.width, x + size)):
                at = row * scene.width + column
                image[3 * at : 3 * at + 3] = bytes(3 * [int(255 * scene.values["light"])])
                ids[at] = node.id
    drawn = {"image": image, "instance": ids}
    if FAULT == "boxes":
        drawn["amodal_box"] = boxes
    return drawn


if FAULT == "silent":
    time.sleep(600)
if FAULT == "gone":
    sys.exit("no licence")
serve(render, version=os.environ.get("TEST_VERSION", ""))
