"""Train a detector straight from the grammar, without files: every step sees scenes that no step before has seen.

    python examples/train_detector.py                              # the prior of multi_mnist, half a minute on a CPU
    python examples/train_detector.py runs/one --steps 2000 --workers 2
    python examples/train_detector.py examples/tabletop.py

The detector is torchvision's small Faster R-CNN, from scratch; what it reaches is not the point here.
"""

import argparse
from itertools import islice

import torch
from torch.utils.data import DataLoader
from torchvision.models.detection import fasterrcnn_mobilenet_v3_large_320_fpn

from probscene.app.datasets.scene_dataset import SceneDataset


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("source", nargs="?", default="multi_mnist", metavar="RUN", help="a run, or a model's prior")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--batch-size", type=int, default=4)
    parser.add_argument("--workers", type=int, default=0, help="processes that draw scenes")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.manual_seed(args.seed)

    dataset = SceneDataset(args.source, seed=args.seed, min_visible=0.2, batch_size=args.batch_size)
    loader = DataLoader(
        dataset,
        batch_size=args.batch_size,
        collate_fn=SceneDataset.collate,
        num_workers=args.workers,
        multiprocessing_context="spawn" if args.workers else None,
    )
    detector = fasterrcnn_mobilenet_v3_large_320_fpn(
        weights=None,
        weights_backbone=None,
        num_classes=len(dataset.classes) + 1,
        min_size=min(dataset.model.canvas),
        max_size=max(dataset.model.canvas),
        box_batch_size_per_image=64,  # of the default 512 regions, most would be background; eight times the work
    ).train()
    sgd = torch.optim.SGD(detector.parameters(), lr=0.005, momentum=0.9, weight_decay=1e-4)
    for step, (images, targets) in enumerate(islice(loader, args.steps)):
        losses = detector(images, targets)
        loss = torch.stack([*losses.values()]).sum()
        sgd.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(detector.parameters(), 10.0)
        sgd.step()
        objects = sum(len(target["labels"]) for target in targets)
        print(f"step {step:4d}  {objects:3d} objects  loss {loss.item():.3f}")


if __name__ == "__main__":
    main()
