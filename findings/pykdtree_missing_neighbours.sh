#!/usr/bin/env bash
# pykdtree 1.4.3 gives a missing neighbour a finite distance, and an index beyond every array.
#
# Its README says that it is used as SciPy's cKDTree, which gives the distance inf and the index n
# where fewer than k points are there. Seen: for k=3 and two points, pykdtree's third distance is
# 1.3e154 and its index 4294967295, so that tests for inf or for the index n find nothing, and means
# of distances explode. With a distance_upper_bound it answers with inf and n, as SciPy does.
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pykdtree==1.4.3 scipy==1.16.3 numpy==2.3.5
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import numpy
from pykdtree.kdtree import KDTree
from scipy.spatial import cKDTree

points = numpy.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
ours, theirs = KDTree(points).query(points[:1], k=3), cKDTree(points).query(points[:1], k=3)
bounded = KDTree(points).query(points[:1], k=3, distance_upper_bound=10.0)
print("pykdtree:", *(part.tolist() for part in ours))
print("pykdtree, distance_upper_bound=10:", *(part.tolist() for part in bounded))
print("SciPy:", *(part.tolist() for part in theirs))
same = numpy.isfinite(ours[0][0, 2]) and ours[1][0, 2] == 2**32 - 1
same = same and numpy.isinf(bounded[0][0, 2]) and bounded[1][0, 2] == 2
raise SystemExit(0 if same and numpy.isinf(theirs[0][0, 2]) and theirs[1][0, 2] == 2 else 1)
PYTHON
