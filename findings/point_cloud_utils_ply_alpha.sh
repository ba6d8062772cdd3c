#!/usr/bin/env bash
# point-cloud-utils 0.34.0 reads RGB colours of PLY files with an alpha of arbitrary numbers.
#
# load_mesh_vc returns an array (N, 4) for a file with red, green and blue, and leaves the last
# column as the memory was, where a reader would expect 255 (opaque) or three columns. Seen: of
# 1,000 points, alpha takes 15 or more values between 0 and 255. The first three columns are right.
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q point-cloud-utils==0.34.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys

import numpy
import point_cloud_utils

path = f"{sys.argv[1]}/cloud.ply"
colours = numpy.stack([numpy.arange(1000) % 256, numpy.full(1000, 128), numpy.full(1000, 64)], 1)
header = [
    "ply",
    "format ascii 1.0",
    "element vertex 1000",
    *(f"property float {name}" for name in "xyz"),
]
header += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header"]
with open(path, "w") as file:
    print(
        *header,
        *(f"{row} {row} 0 {red} {green} {blue}" for row, (red, green, blue) in enumerate(colours)),
        sep="\n",
        file=file,
    )
points, read = point_cloud_utils.load_mesh_vc(path)
alpha = numpy.unique(read[:, 3])
print(
    f"colours {read.shape} {read.dtype}; the first three columns are right: {(read[:, :3] == colours).all()}"
)
print(f"alpha has {len(alpha)} values: {alpha[:20].tolist()} …")
raise SystemExit(0 if read.shape == (1000, 4) and len(alpha) > 1 else 1)
PYTHON
