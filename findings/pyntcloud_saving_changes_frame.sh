#!/usr/bin/env bash
# pyntcloud 0.3.1 rounds the caller's own table to single precision when a cloud is saved.
#
# A PyntCloud holds the DataFrame that it is made of, not a copy, and to_file converts every float64
# column of it to float32 before it writes, in each format that can be written. Seen: after saving
# one point at (500000.123, 5400000.456) with a GPS time as text, .npz, .obj or .bin, the table that
# the caller still holds says (500000.125, 5400000.5), and the time has lost 3.75 seconds.
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pyntcloud==0.3.1 pandas==2.3.3 numpy
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys

import pandas
from pyntcloud import PyntCloud

POINT = {"x": 500000.123, "y": 5400000.456, "z": 300.789, "gps_time": 100000003.75}
rounded = {"x": 500000.125, "y": 5400000.5, "z": 300.78900146484375, "gps_time": 100000000.0}
same = True
for suffix in ("npz", "txt", "obj", "bin"):
    table = pandas.DataFrame([POINT] * 3)
    cloud = PyntCloud(table)
    before = table.iloc[0].to_dict()
    cloud.to_file(f"{sys.argv[1]}/cloud.{suffix}")
    after = table.iloc[0].to_dict()
    print(f"{suffix}: the caller's table before {before}, after {after}")
    same &= before == POINT and after == rounded
sys.exit(not same)
PYTHON
