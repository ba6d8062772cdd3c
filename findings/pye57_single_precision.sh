#!/usr/bin/env bash
# pye57 0.4.19 writes float64 coordinates in single precision, and reads them back as float64.
#
# E57 stores doubles, and pye57 reads those of other programs exactly. write_scan_raw takes float64
# arrays and writes single precision without a word; what it reads back is float64 again, so that
# the type hides the loss. Seen: a point at a northing of 5400000.456 m comes back at 5400000.5.
# The pose of a scan is kept in double precision: with the coordinates relative to a point, and this
# point as the translation, read_scan gives them back to the micrometre.
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pye57==0.4.19 numpy
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys

import numpy as np
import pye57

POINTS = np.array([[500000.123, 5400000.456, 300.789], [500010.987, 5400020.654, 305.321]])
NAMES = ("cartesianX", "cartesianY", "cartesianZ")


def written_and_read(path, points, **pose):
    """Return the points of a scan that was written and read by pye57."""
    file = pye57.E57(path, mode="w")
    file.write_scan_raw(dict(zip(NAMES, points.T.copy())), **pose)
    file.close()
    fields = pye57.E57(path).read_scan(0, ignore_missing_fields=True)
    return np.stack([fields[name] for name in NAMES], axis=1)


plain = written_and_read(f"{sys.argv[1]}/plain.e57", POINTS)
origin = POINTS[0]
moved = written_and_read(
    f"{sys.argv[1]}/moved.e57",
    POINTS - origin,
    rotation=np.array([1.0, 0.0, 0.0, 0.0]),
    translation=origin,
)
print("without a pose:", plain.dtype, plain.tolist())
print("with the first point as translation:", moved.dtype, moved.tolist())
is_single = np.array_equal(plain, POINTS.astype(np.float32).astype(np.float64))
error = np.abs(moved - POINTS).max()
sys.exit(not (plain.dtype == np.float64 and is_single and error < 1e-6))
PYTHON
