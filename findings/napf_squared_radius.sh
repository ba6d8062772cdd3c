#!/usr/bin/env bash
# napf 0.1.0 takes squared radii and returns squared distances where it promises SciPy's calls.
#
# Its KDT has query and query_ball_point, called "scipy-like", and radius_search with a `radius`.
# Neither documentation nor names mention squares. Seen: with its default metric, all points within
# the square root of the radius come back, which for a unit cube and 0.1 are twenty times as many, and
# distances are squared. SciPy's cKDTree takes and returns plain ones.
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q napf==0.1.0 scipy==1.16.3 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import napf
import numpy
from scipy.spatial import cKDTree

RADIUS = 0.1
generator = numpy.random.default_rng(0)
points = generator.random((5000, 3))
queries = generator.random((300, 3))
tree, reference = napf.KDT(points), cKDTree(points)


def equal(found, expected):
    """Return whether two lists of rows agree, in any order."""
    pairs = zip(found, expected, strict=True)
    return all(sorted(map(int, a)) == sorted(b) for a, b in pairs)


in_ball = tree.query_ball_point(queries, RADIUS, False)
within = reference.query_ball_point(queries, RADIUS)
within_root = reference.query_ball_point(queries, RADIUS**0.5)
print(f"points within {RADIUS} of the first query: napf {len(in_ball[0])}, SciPy {len(within[0])}")
print(f"SciPy, within {RADIUS**0.5:.3f}: {len(within_root[0])}")
print(f"napf's rows are those within {RADIUS}: {equal(in_ball, within)}")
print(f"napf's rows are those within its square root: {equal(in_ball, within_root)}")

distances = tree.query(queries)[0].ravel()
plain = reference.query(queries)[0]
print(f"largest difference from SciPy's distances: {abs(distances - plain).max():.3f}")
print(f"from their squares: {abs(distances - plain**2).max():.1e}")

same = equal(in_ball, within_root) and not equal(in_ball, within)
same = same and numpy.allclose(distances, plain**2) and not numpy.allclose(distances, plain)
raise SystemExit(0 if same else 1)
PYTHON
