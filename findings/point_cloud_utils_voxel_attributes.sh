#!/usr/bin/env bash
# point-cloud-utils 0.34.0 averages the third and later columns of attributes wrongly in voxels.
#
# downsample_point_cloud_on_voxel_grid promises the average of the points of each voxel, and of
# their attributes. Coordinates are right, and so are attributes of one or two columns. Of wider
# ones, such as colours and normals, the sums of the third and all later columns do not begin at
# zero: mostly, the first point of a voxel is counted twice, so that the blue of a voxel with one
# point is doubled (up to 510 of 255); some sums begin at any number that the memory held (1e140 was
# seen).
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q point-cloud-utils==0.34.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import numpy
import point_cloud_utils

SIDE = 0.2
generator = numpy.random.default_rng(0)
points = generator.random((2000, 3))
colours = generator.integers(1, 256, (2000, 3)).astype(numpy.float64)
low, high = [-0.05] * 3, [1.05] * 3

centres, means = point_cloud_utils.downsample_point_cloud_on_voxel_grid(
    SIDE, points, colours, min_bound=low, max_bound=high
)
_, voxel, number = numpy.unique(
    numpy.floor((points - low) / SIDE), axis=0, return_inverse=True, return_counts=True
)
voxel = voxel.ravel()
average = numpy.stack(
    [numpy.bincount(voxel, column) / number for column in (*points.T, *colours.T)], 1
)
average = average[numpy.lexsort(average.T[:3])]
order = numpy.lexsort(centres.T)
assert len(centres) == len(average), (len(centres), len(average))
right = numpy.isclose(numpy.hstack([centres, means])[order], average).mean(0)
for name, share in zip(("x", "y", "z", "red", "green", "blue"), right):
    print(f"{name}: right in {share:.0%} of {len(centres)} voxels")
print(f"blue, the first voxels: {means[order][:5, 2].tolist()}, right: {average[:5, 5].tolist()}")
raise SystemExit(0 if (right[:5] == 1).all() and right[5] < 0.5 else 1)
PYTHON
