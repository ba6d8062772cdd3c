#!/usr/bin/env bash
# laspy 2.7.0's convert sets all scan angles to 0 between point formats 0-5 and 6-10.
#
# Formats 0 to 5 have a scan_angle_rank in degrees, formats 6 to 10 a scan_angle in steps of 0.006
# degrees: one quantity in two units. Points with angles from -30 to 30 degrees are converted from 3
# to 7 and from 7 to 3, without a file. Seen: both ways every angle is 0, and nothing is said;
# lost_dimensions names the dimension, and coordinates, colours and classes stay. (Copy the angles
# yourself: rank = 0.006 * angle.)
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q laspy==2.7.0 numpy
"$folder/venv/bin/python" -W error - <<'PYTHON'
import sys

import laspy
import numpy as np

NAMES = {3: "scan_angle_rank", 7: "scan_angle"}
DEGREES = {3: 1.0, 7: 0.006}
angles = np.linspace(-30, 30, 61)
same = True
for form, other in ((3, 7), (7, 3)):
    made = laspy.LasData(laspy.LasHeader(point_format=form, version="1.4"))
    made.x = made.y = made.z = np.arange(61.0)
    made.red = made.classification = np.arange(61) % 32
    made[NAMES[form]] = np.round(angles / DEGREES[form])
    converted = laspy.convert(made, point_format_id=other)
    found = np.asarray(converted[NAMES[other]]) * DEGREES[other]
    names = ("x", "red", "classification")
    kept = all(np.array_equal(made[name], converted[name]) for name in names)
    lost = laspy.lost_dimensions(form, other)
    print(f"{form} -> {other}: angles {found.min()} to {found.max()} degrees, others kept: {kept}")
    print(f"  lost_dimensions: {lost}")
    same &= not found.any() and kept and NAMES[form] in lost
sys.exit(not same)
PYTHON
