"""Find how far generated points lie outside their clouds, and what accuracy that gives.

    python benchmarks/outside_hull.py FOLDER TASK_NET RUN ... [--clouds 600]

FOLDER is a ModelNet40 folder, of which test shapes are read (those of held_out.py are held-out
training shapes); TASK_NET and every RUN are folders of runs or weights: the classifier, and
samplers that were trained under it. For every sampler: the share of its generated points outside
the convex hull, the mean distance to the nearest input point, and the accuracy of generated points,
of these with the points outside moved to the nearest input points, and of matched points.
"""

import argparse
from pathlib import Path

import h5py
import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

import mops_lightning
from mops_lightning.data.hdf5 import read_lines
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import match
from mops_lightning.zoo.load import load_net

BATCH = 64
ROUNDING = 1e-4
"""Distance from a hull, in unit spheres, below which a point counts as on it."""


def outside(points: Tensor, cloud: Tensor) -> Tensor:
    """Return which points ``(M, 3)`` lie outside the convex hull of a cloud ``(N, 3)``."""
    equations = ConvexHull(cloud.numpy()).equations
    normals = equations[:, :3]
    distances = points.numpy() @ normals.T + equations[:, 3]
    farthest = distances.max(axis=1)
    return torch.from_numpy(farthest > ROUNDING)


@torch.no_grad()
def accuracy(net: torch.nn.Module, points: Tensor, labels: Tensor) -> float:
    """Return the accuracy in % of a classifier for sets ``(B, M, 3)``."""
    right = 0
    for batch, of_batch in zip(points.split(BATCH), labels.split(BATCH), strict=True):
        right += int((net(batch).argmax(1) == of_batch).sum())
    return 100 * right / len(points)


def report(name: str, net: torch.nn.Module, clouds: Tensor, labels: Tensor) -> None:
    """Print the figures of one sampler."""
    sampler = mops_lightning.load(name)
    with torch.no_grad():
        generated = torch.cat([sampler(batch).points for batch in clouds.split(BATCH)])
    matched = gather_points(clouds, match(generated, clouds))
    distances = (generated - matched).norm(dim=2)
    is_outside = torch.stack([outside(*pair) for pair in zip(generated, clouds, strict=True)])
    moved = torch.where(is_outside[:, :, None], matched, generated)
    share = 100 * float(is_outside.float().mean())
    print(
        f"{name}: outside {share:.1f} %, distance {float(distances.mean()):.3f}, generated "
        f"{accuracy(net, generated, labels):.2f} %, moved {accuracy(net, moved, labels):.2f} %, "
        f"matched {accuracy(net, matched, labels):.2f} %",
        flush=True,
    )


def main() -> None:
    """Read the clouds and print a line for every sampler."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder with test_files.txt")
    parser.add_argument("task_net", help="run that trained the classifier")
    parser.add_argument("runs", nargs="+", help="runs that trained samplers under it")
    parser.add_argument("--clouds", type=int, default=600, help="clouds to read")
    arguments = parser.parse_args()

    first, *_ = read_lines(arguments.folder / "test_files.txt")
    with h5py.File(arguments.folder / Path(first).name) as file:
        data = file["data"][: arguments.clouds]
        classes = file["label"][: arguments.clouds]
    clouds = torch.from_numpy(data)
    labels = torch.from_numpy(classes.astype(np.int64)).flatten()
    net = load_net(arguments.task_net)
    for name in arguments.runs:
        report(name, net, clouds, labels)


if __name__ == "__main__":
    main()
