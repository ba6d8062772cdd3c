"""``python benchmarks/scans_icp.py FOLDER RUN``: registration of crops of scans from m points.

Each held-out crop of ``experiment=own_scans`` is split at random into two halves without shared
points. m points of one half, sampled by each method and moved at random, are aligned with the
other half by point-to-plane ICP (small_gicp). What counts is the angle that is left.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import small_gicp
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mops_lightning import farthest_point_sample, load
from mops_lightning.data.cloud_folder import cloud_folder
from mops_lightning.filesystem import atomic_write
from mops_lightning.records import run_record

SIZES = (16, 32, 64, 128)  # ICP refuses fewer than 10 points
ANGLE, SHIFT = 15.0, 0.1
"""Largest angle in degrees and largest shift, in radii of a crop, of the motions."""
ALIGNED = 2.0
"""Degrees of error below which a pair counts as aligned."""
SETTINGS = {"registration_type": "PLANE_ICP", "max_correspondence_distance": 0.3}
LIMITS = {"max_iterations": 60, "rotation_epsilon": 1e-5, "translation_epsilon": 1e-5}


def samples(clouds: Tensor, m: int, run: str, rng: torch.Generator) -> dict[str, Tensor]:
    """Return the sampled rows ``(B, m)`` by method."""
    n = clouds.shape[1]
    starts = torch.randint(n, (len(clouds),), generator=rng)
    far = (clouds - clouds.mean(1, keepdim=True)).square().sum(2).argmax(1)
    own = load(run).downsample(clouds, m)[1]
    return {
        "random": torch.rand(clouds.shape[:2], generator=rng).argsort(1)[:, :m],
        "FPS from a random point": farthest_point_sample(clouds, m, starts),
        "FPS from the farthest point": farthest_point_sample(clouds, m, far),
        "own sampler, completed": own,
    }


def left_over(source: np.ndarray, target: small_gicp.PointCloud, motion: Rotation) -> float:
    """Return the degrees between the motion and what ICP finds."""
    shift = motion.as_rotvec() * (SHIFT / np.radians(ANGLE))
    moved = small_gicp.PointCloud(motion.apply(source) + shift)
    tree = small_gicp.KdTree(target)
    found = small_gicp.align(target, moved, tree, **SETTINGS, **LIMITS).T_target_source
    return float(np.degrees((Rotation.from_matrix(found[:3, :3]) * motion).magnitude()))


def main() -> None:
    """Align all crops and write the errors as a record and a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", help="of scans, with train/ and test/")
    parser.add_argument("run", help="of experiment=own_scans on this folder")
    parser.add_argument("--motions", type=int, default=5, help="of each crop")
    parser.add_argument("--out", type=Path, required=True, help="without suffix")
    chosen = parser.parse_args()
    node = run_record.read(Path(chosen.run)).config["dataset"]
    settings = {name: node[name] for name in node if name not in ("_target_", "root")}
    clouds = cloud_folder(chosen.folder, **settings).test.points
    rng, numbers = torch.Generator().manual_seed(0), np.random.default_rng(0)
    halves = torch.stack([cloud[torch.randperm(1024, generator=rng)] for cloud in clouds])
    moving, fixed = halves.split(512, 1)
    targets = [small_gicp.PointCloud(cloud.double().numpy()) for cloud in fixed]
    for target in targets:
        small_gicp.estimate_normals(target, num_neighbors=12)
    axes = numbers.normal(size=(len(clouds) * chosen.motions, 3))
    angles = np.radians(ANGLE) * numbers.random((len(axes), 1))
    axes *= angles / np.linalg.norm(axes, axis=1, keepdims=True)
    motions = [Rotation.from_rotvec(axis) for axis in axes]
    rows = []
    for m in (*SIZES, 512):
        every = {"all 512 points": torch.arange(512).expand(len(clouds), -1)}
        for name, chosen_rows in (
            every if m == 512 else samples(moving, m, chosen.run, rng)
        ).items():
            errors = [
                left_over(moving[i][chosen_rows[i]].double().numpy(), targets[i], motion)
                for i in range(len(clouds))
                for motion in motions[i :: len(clouds)]
            ]
            aligned = 100 * np.mean(np.array(errors) < ALIGNED)
            row = {"m": m, "sampled by": name, "median_error": float(np.median(errors))}
            rows.append({**row, "aligned_percent": float(aligned), "pairs": len(errors)})
            print(rows[-1], flush=True)
    record = {"crops": len(clouds), "motions": chosen.motions, "angle": ANGLE, "rows": rows}
    with atomic_write(chosen.out.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
