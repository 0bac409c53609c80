"""Real photographs as a target of Aerial 2D: the KIT AIS frames, Munich's streets from the air, cut into crops.

    python examples/kit_ais.py DATA --out FOLDER
    probscene fit aerial2d --features efficientnet --target FOLDER/fit/images --out RUN
    probscene evaluate RUN --target FOLDER/fit/images --labels FOLDER/fit/counts.csv

DATA holds frames (PNG, JPEG or TIFF) with a YOLO file of the same name beside each, whose class 0 is car; nothing is
fetched. A sequence is the frames of one size whose names count on. Its frames are near duplicates, so one sequence is
held out whole, and the crops of the others say less than their number.

Every sequence is scaled by one factor, so that its median car is as long as the model's, 18 pixels, or, where the frame
would then be lower than a crop, so that it is just as high. Crops are 256 x 256, ``--stride`` pixels apart in both
directions from the upper left corner, all of them, neither turned nor mirrored. ``counts.csv`` has the cars whose box
has its middle in the crop; buses, trucks and minibuses are no cars, and roads are not labelled. Labels serve to scale
and to judge; a fit sees images alone.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

from probscene.app.files import make_folder
from probscene.app.labels.counts import write_counts
from probscene.dataset import is_image
from probscene.decoding import read_rgb
from probscene.errors import DataError, ProbsceneError

CROP, CAR = 256, 18.0  # pixels: a crop's side and the length of the model's cars
CARS = 0  # their number in the YOLO files


def boxes(frame: Path, width: int, height: int) -> np.ndarray:
    """The cars of a frame, ``(cars, 4)``: x and y of the middle, width and height, pixels.

    Raises:
        DataError: no YOLO file, or a line that is none of YOLO.
    """
    file = frame.with_suffix(".txt")
    if not file.is_file():
        raise DataError(f"expected YOLO labels of {frame.name} in {file}, got none; name the folder that has them.")
    found = []
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
        try:
            kind, *box = map(float, line.split())
            box = np.array(box).reshape(4)
        except ValueError:
            raise DataError(f"expected 'class x y width height' in line {number} of {file}, got {line!r}.") from None
        if kind == CARS:
            found.append(box * (width, height, width, height))
    return np.array(found).reshape(-1, 4)


def sequences(data: Path) -> list[tuple[str, list[Path]]]:
    """The frames of a folder by sequence, whose name is that of its first frame.

    Raises:
        DataError: no frames, or one that does not decode.
    """
    frames = sorted(filter(is_image, data.glob("*")))
    if not frames:
        raise DataError(f"expected frames (PNG, JPEG or TIFF) with YOLO labels in {data}, got none.")
    found, last = [], None
    for key in sorted(map(_key, frames), key=lambda key: key[:3]):
        *place, number, frame = key
        if last != (*place, number - 1):
            found.append((frame.stem, []))
        found[-1][1].append(frame)
        last = (*place, number)
    return found


def crops(frames: list[Path], stride: int) -> tuple[float, Iterator[tuple[str, np.ndarray, int]]]:
    """The factor that a sequence is scaled by, and its crops ``(256, 256, 3)``: name, pixels and number of cars."""
    first = read_rgb(frames[0])
    height, width = first.shape[:2]
    labels = [boxes(frame, width, height) for frame in frames]
    every = np.concatenate(labels)
    length = float(np.median(every[:, 2:].max(1))) if len(every) else CAR
    scale = max(CAR / length, CROP / min(height, width))
    size = (max(CROP, round(width * scale)), max(CROP, round(height * scale)))

    def each():
        for frame, cars in zip(frames, labels, strict=True):
            how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
            whole = cv2.resize(read_rgb(frame), size, interpolation=how)
            middle = cars[:, :2] * (size[0] / width, size[1] / height)
            for y in range(0, size[1] - CROP + 1, stride):
                for x in range(0, size[0] - CROP + 1, stride):
                    inside = ((middle >= (x, y)) & (middle < (x + CROP, y + CROP))).all(1)
                    yield f"{frame.stem}-{x}-{y}.png", whole[y : y + CROP, x : x + CROP], int(inside.sum())

    return scale, each()


def write(folder: Path, parts: list[tuple[str, list[Path]]], stride: int) -> None:
    """``images/`` and ``counts.csv`` of some sequences."""
    make_folder(folder / "images")
    names, counts = [], []
    for sequence, frames in parts:
        scale, each = crops(frames, stride)
        before = len(names)
        for name, pixels, cars in each:
            if not cv2.imwrite(str(folder / "images" / name), pixels[..., ::-1]):
                raise DataError(f"Could not write {folder / 'images' / name}.")
            names.append(name)
            counts.append([cars])
        mean = np.mean(counts[before:])
        print(f"{sequence}: {len(frames)} frames times {scale:.3f}, {len(names) - before} crops, {mean:.2f} cars each")
    write_counts(folder / "counts.csv", names, np.array(counts), ("car",))


def _key(frame: Path) -> tuple[tuple[int, int], str, int, Path]:
    prefix = frame.stem.rstrip("0123456789")
    digits = frame.stem.removeprefix(prefix)
    height, width = read_rgb(frame).shape[:2]
    return (height, width), prefix, int(digits or 0), frame


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("data", type=Path, help="folder of frames and their YOLO files")
    parser.add_argument("--out", type=Path, required=True, help="folder for fit/ and held_out/")
    parser.add_argument("--stride", type=int, default=64, help="pixels between crops")
    parser.add_argument("--held-out", default="MunichStreet02-MOS74", help="first frame of the sequence that is")
    args = parser.parse_args()
    try:
        if args.stride < 1:
            raise ProbsceneError(f"expected a positive stride, got {args.stride}.")
        found = sequences(args.data)
        aside = [part for part in found if part[0] == args.held_out]
        if not aside or len(found) == 1:
            names = ", ".join(name for name, _ in found)
            raise DataError(
                f"expected --held-out among the sequences {names}, and another to fit, got {args.held_out}."
            )
        write(args.out / "fit", [part for part in found if part[0] != args.held_out], args.stride)
        write(args.out / "held_out", aside, args.stride)
    except ProbsceneError as error:
        Console(stderr=True).print(f"kit_ais: {error}", soft_wrap=True, highlight=False)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
