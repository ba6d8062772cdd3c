#!/usr/bin/env bash
# small_gicp 1.0.1's voxel filter returns one point for a cloud in map coordinates.
#
# 20,000 points of 50 × 50 × 10 m are filtered with voxels of 1 and 0.5 m, at the origin and at UTM
# coordinates (500,000 m east, 4,649,000 m north). Seen: thousands of means at the origin, one of the
# input points at the UTM coordinates. Of a cloud with 100 points at the origin and the rest on the
# map, the 100 are left. Voxels are counted from the origin in 21 bits, and every point beyond them
# prints "warning: voxel coord is out of range!!" on stderr; nothing is raised. (Subtract a corner of
# the cloud first, and add it to the result.)
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q small_gicp==1.0.1 numpy
"$folder/venv/bin/python" - 2> "$folder/warnings" <<'PYTHON'
import sys

import numpy as np
import small_gicp

UTM = np.array([500_000.0, 4_649_000.0, 200.0])
local = np.random.default_rng(0).random((20_000, 3)) * [50, 50, 10]
same = True
for size in (1.0, 0.5):
    at_origin = small_gicp.voxelgrid_sampling(local, size).points()
    on_map = small_gicp.voxelgrid_sampling(local + UTM, size).points()
    print(f"voxels of {size} m: {len(at_origin)} points at the origin, {len(on_map)} on the map")
    is_input = (local + UTM == on_map[0, :3]).all(1).any()
    print(f"  an input point: {is_input}")
    same &= len(at_origin) > 10_000 and len(on_map) == 1 and bool(is_input)
both = np.concatenate([local[:100], local[100:] + UTM])
left = small_gicp.voxelgrid_sampling(both, 0.01).points()
on_map = int((left[:, 0] > 1000).sum())
print(f"100 points at the origin, 19,900 on the map: {len(left)} left, {on_map} of them on the map")
same &= len(left) == 100 and not on_map
sys.exit(not same)
PYTHON
sort "$folder/warnings" | uniq -c
