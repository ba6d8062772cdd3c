#!/usr/bin/env bash
# point-cloud-utils 0.34.0's removal of duplicates keeps close pairs and removes distant ones.
#
# deduplicate_point_cloud(points, epsilon) says that two points are the same if their distance is
# below epsilon. It rounds coordinates to multiples of epsilon instead, so that it depends on where
# a pair lies. Seen: with epsilon 1, points at x = 0.4 and 0.6 both stay, and of (0.55, 0.55, 0.55)
# and (1.45, 1.45, 1.45), 1.56 apart, one goes. Of 1,000 random pairs a tenth of epsilon apart, 141
# are still two. (A single point comes back as an array (3,).)
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


def kept(points, epsilon):
    """Return how many of the points are kept."""
    result = point_cloud_utils.deduplicate_point_cloud(
        numpy.asarray(points, numpy.float64), epsilon
    )[0]
    return result.size // 3  # a single point comes back without its first axis


near = kept([[0.4, 0, 0], [0.6, 0, 0]], 1.0)
far = kept([[0.55, 0.55, 0.55], [1.45, 1.45, 1.45]], 1.0)
generator = numpy.random.default_rng(0)
first = generator.random((1000, 3)) * 100
directions = generator.normal(size=(1000, 3))
second = first + 1e-3 * 0.1 * directions / numpy.linalg.norm(directions, axis=1, keepdims=True)
pairs = kept(numpy.concatenate([first, second]), 1e-3) - 1000
print(f"two points 0.2 epsilon apart: {near} kept; two points 1.56 epsilon apart: {far} kept")
print(f"of 1,000 pairs 0.1 epsilon apart, {pairs} are still two points")
raise SystemExit(0 if near == 2 and far == 1 and 50 < pairs < 300 else 1)
PYTHON
