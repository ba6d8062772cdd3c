#!/usr/bin/env bash
# point-cloud-utils 0.34.0 averages the third and later columns of attributes wrongly in voxels.
#
# downsample_point_cloud_on_voxel_grid promises the average of the points of each voxel, and of
# their attributes. Coordinates are right, and so are attributes of one or two columns. Of wider
# ones, such as colours and normals, the sums of the third and all later columns do not begin at
# zero. Seen: in more than nine of ten voxels, the first point is counted twice in them, so that blue
# exceeds 255.
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q point-cloud-utils==0.34.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy
import point_cloud_utils

SIDE = 0.2
LOW, HIGH = [-0.05] * 3, [1.05] * 3
generator = numpy.random.default_rng(0)
points = generator.random((2000, 3))
cells = numpy.floor((points - LOW) / SIDE)
_, first, voxel, number = numpy.unique(
    cells, axis=0, return_index=True, return_inverse=True, return_counts=True
)


def averages(columns):
    """Return the mean of columns in every voxel."""
    sums = [numpy.bincount(voxel.ravel(), column) for column in columns.T]
    return numpy.stack(sums, 1) / number[:, None]


same = True
centres = averages(points)
for width in (1, 2, 3, 5):
    attribute = generator.integers(1, 256, (2000, width)).astype(numpy.float64)
    found = point_cloud_utils.downsample_point_cloud_on_voxel_grid(
        SIDE, points, attribute, min_bound=LOW, max_bound=HIGH
    )
    order, own_order = numpy.lexsort(found[0].T), numpy.lexsort(centres.T)
    assert numpy.allclose(found[0][order], centres[own_order])
    means = found[1].reshape(-1, width)[order]
    right = averages(attribute)[own_order]
    twice = right + (attribute[first] / number[:, None])[own_order]
    shares = numpy.isclose(means, right).mean(0)
    doubled = numpy.isclose(means, twice).mean(0)
    print(f"{width} columns: right in {numpy.round(shares, 2).tolist()} of {len(means)} voxels,")
    print(f"  the first point counted twice in {numpy.round(doubled, 2).tolist()}")
    if width == 3:
        print(f"  blue exceeds 255 in {(means[:, 2] > 255).sum()} voxels")
    same = same and (shares[:2] == 1).all() and (shares[2:] < 0.5).all() and (doubled[2:] > 0.5).all()
raise SystemExit(0 if same else 1)
PYTHON
