"""Whether a change of the code leaves results as they were: seven tiny fits, and digests of what they made.

    python benchmarks/same_bytes.py --out before > before.txt        # on the old commit
    python benchmarks/same_bytes.py --out after > after.txt          # on the new one
    diff before.txt after.txt
    python benchmarks/same_bytes.py --open before > opened.txt       # the new code reads the old commit's runs

A fit's line has SHA-256 digests, cut to 16 characters, of

    guide    the guide's tensors, names included
    others   the tensors of the feature network and of the learnt parameters
    log      every number in the log, in order; the names beside them may change
    records  every number and truth value in the records of readings, parameters and outcome
    images   128 images and their COCO labels, drawn from the learnt guide and parameters
    verdict  every number that ``probscene evaluate`` writes, with the truth as labels

``--open`` prints the last digest of runs that another commit made. Digests are those of one machine and one set of
versions: they are compared and not kept. A fit takes some seconds and learns nothing worth having.
"""

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from given import out_option

import probscene as ps
from probscene.app.fitting.config import configuration
from probscene.app.fitting.presets import preset

IMAGES, TARGET_IMAGES, LABELLED = 128, 48, 8
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
TABLETOP = str(EXAMPLES / "tabletop.py")
STRUCTURE = {"pretrain.derivations": 100, "pretrain.epochs": 2, "structure.batches": 3, "structure.num_scenes": 32}
COUNTS = {
    "features.schedule.steps": 48,
    "features.schedule.images": 4,
    "features.schedule.crops": 4,
    "features.width": (4, 8, 8),
}
LIKELIHOOD = {
    "parameters.reader_steps": 20,
    "parameters.scene_renders": 32,
    "parameters.reader_images": 4,
    "parameters.steps": 6,
    "parameters.rounds": 1,
    "parameters.round_reader_steps": 6,
    "parameters.recalibration_renders": 400,
    "parameters.round_scene_renders": 16,
    "parameters.round_steps": 4,
    "refine.batches": 2,
}
HEADS = {"features.pairs": 24, "features.epochs": 1, "features.photographs": 24}
TILTING = {
    "parameters.rounds": 2,
    "parameters.first": 64,
    "parameters.scenes": 24,
    "parameters.steps": 4,
    "refine.batches": 2,
}
META_SIM = {
    "parameters.steps": 3,
    "parameters.scenes": 6,
    "parameters.values": 10,
    "parameters.feature_size": 96,
    "parameters.hidden": 8,
    "refine.batches": 2,
}
PRESENCE = {"features.images": 48, "features.epochs": 1}
FITS: dict[str, dict[str, Any]] = {
    "digits": {"model": "multi_mnist", "features": "count", "settings": STRUCTURE | COUNTS | LIKELIHOOD},
    "groups": {
        "model": "aerial2d",
        "features": "count",
        "divergence": "js",
        "guide": "pcfg",
        "parameters": "none",
        "settings": STRUCTURE | COUNTS,
    },
    "street": {
        "model": "driving_simple:rural",
        "preset": "street",
        "features": "count",
        "settings": STRUCTURE | COUNTS | LIKELIHOOD | {"structure.num_scenes": 16, "features.width": (4, 4, 4)},
    },
    "photographs": {
        "model": TABLETOP,
        "features": "count=efficientnet",
        "labels": LABELLED,
        "parameters": "tilting",
        "settings": STRUCTURE | HEADS | TILTING,
    },
    "projection": {
        "model": TABLETOP,
        "features": "efficientnet",
        "divergence": "witness",
        "guide": "grammar-vae",
        "parameters": "meta-sim",
        "settings": STRUCTURE | META_SIM | {"features.pairs": 24, "num_crops": 2},
    },
    "scenarios": {
        "model": "driving_simple:rural,suburban",
        "features": "presence",
        "divergence": "mmd",
        "parameters": "none",
        "settings": STRUCTURE | PRESENCE | {"structure.num_scenes": 12},
    },
    "plug-ins": {
        "model": TABLETOP,
        "features": f"{EXAMPLES}/own_features.py:TinyCounts",
        "divergence": f"{EXAMPLES}/own_divergence.py:energy",
        "guide": f"{EXAMPLES}/own_guide.py:PlaceGuide",
        "parameters": "none",
        "settings": STRUCTURE,
    },
}


def digest(*parts: bytes) -> str:
    """The first 16 hexadecimal characters of SHA-256."""
    return hashlib.sha256(b"".join(parts)).hexdigest()[:16]


def numbers(record: Any) -> Iterator[str]:
    """Numbers and truth values of JSON, in order."""
    if isinstance(record, dict | list):
        for part in record.values() if isinstance(record, dict) else record:
            yield from numbers(part)
    elif isinstance(record, bool | int | float):
        yield repr(record)


def numbers_in(file: Path) -> bytes:
    """Of every line of JSON, or of a whole file of it; nothing where there is no file."""
    if not file.is_file():
        return b""
    text = file.read_text(encoding="utf-8")
    found = map(json.loads, text.splitlines()) if file.suffix == ".jsonl" else [json.loads(text)]
    return " ".join(number for record in found for number in numbers(record)).encode()


def bytes_of(file: Path) -> bytes:
    """Nothing where there is no file."""
    return file.read_bytes() if file.is_file() else b""


def fit(name: str, out: Path) -> Path:
    """The folder of a finished run."""
    chosen = dict(FITS[name])
    model_name, labelled = chosen.pop("model"), chosen.pop("labels", 0)
    model = ps.load_model(model_name)
    source = model if model.target is None else model.target(0)
    target = out / f"{name}-target"
    ps.generate(source, TARGET_IMAGES, target, format="coco", seed=1, progress=False)
    labels = few_labels(target / "annotations.json", labelled) if labelled else None
    config = configuration(preset(chosen.pop("preset", "quick")), **chosen)
    execution = ps.Execution(threads=1, cache=False, progress=False)
    images = target / "images"
    run = ps.fit(model_name, images, config, seed=3, out=out / name, labels=labels, execution=execution)
    return run.path


def few_labels(file: Path, number: int) -> Path:
    """COCO's file of the first images alone."""
    record = json.loads(file.read_text(encoding="utf-8"))
    images = record["images"][:number]
    ids = {image["id"] for image in images}
    record |= {"images": images, "annotations": [one for one in record["annotations"] if one["image_id"] in ids]}
    path = file.with_name("few.json")
    path.write_text(json.dumps(record), encoding="utf-8")
    return path


def drawn(run: Path, out: Path) -> str:
    """The digest of images and labels that a run's guide gives."""
    shutil.rmtree(out, ignore_errors=True)
    ps.generate(run, IMAGES, out, format="coco", seed=5, progress=False)
    images = (file.read_bytes() for file in sorted((out / "images").iterdir()))
    return digest(*images, numbers_in(out / "annotations.json"))


def evaluated(run: Path, target: Path) -> str:
    """The digest of a verdict and of all distances."""
    file = run.with_name(f"{run.name}-evaluated.json")
    labels = ["--target", target / "images", "--labels", target / "annotations.json"]
    options = ["--num", "500", "--images", str(TARGET_IMAGES), "--scenes", "64", "--json", file]
    command = [sys.executable, "-m", "probscene", "evaluate", run, *labels, *options]
    subprocess.run([str(word) for word in command], check=True, capture_output=True)
    return digest(numbers_in(file))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    out_option(parser, __file__)
    parser.add_argument("--fits", nargs="+", choices=FITS, default=list(FITS))
    parser.add_argument("--open", type=Path, metavar="FOLDER", help="draw from the runs in this --out alone")
    args = parser.parse_args()
    for name in args.fits:
        if args.open is not None:
            print(f"{name:<12} images {drawn(args.open / name, args.out / f'{name}-opened')}", flush=True)
            continue
        shutil.rmtree(args.out / name, ignore_errors=True)
        run = fit(name, args.out)
        found = {
            "guide": digest(bytes_of(run / "guide.safetensors")),
            "others": digest(*(bytes_of(run / f"{part}.safetensors") for part in ("features", "parameters"))),
            "log": digest(numbers_in(run / "log.jsonl")),
            "records": digest(*(numbers_in(run / f"{part}.json") for part in ("readings", "parameters", "outcome"))),
            "images": drawn(run, args.out / f"{name}-drawn"),
            "verdict": evaluated(run, args.out / f"{name}-target"),
        }
        print(f"{name:<12}", *(f"{what} {value}" for what, value in found.items()), flush=True)


if __name__ == "__main__":
    main()
