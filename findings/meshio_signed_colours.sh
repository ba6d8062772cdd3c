#!/usr/bin/env bash
# meshio 5.3.5 reads unsigned bytes of a binary PLY file as signed ones: red 200 becomes -56.
#
# A property uchar, as colours have, becomes int8 if the file is binary, of either byte
# order, and uint8 if it is ascii. Under the name uint8, which the format has as well, it is uint8
# in both. Seen: red 127, 128 and 255 are read as 127, -128 and -1, without a word; written again,
# they are int8, so that the next reader sees them, too. (Reported there in 2022, pull request
# 1320.)
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q meshio==5.3.5 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys

import meshio
import numpy

RED = numpy.array([127, 128, 255], numpy.uint8)


def header(form, name):
    axes = [f"property float {axis}" for axis in "xyz"]
    return "\n".join(
        [
            "ply",
            f"format {form} 1.0",
            "element vertex 3",
            *axes,
            f"property {name} red",
            "end_header",
            "",
        ]
    )


def read(form, name):
    """Return the reds that meshio reads from a file of that form whose bytes have that name."""
    path = f"{sys.argv[1]}/cloud.ply"
    order = ">" if "big" in form else "<"
    rows = numpy.zeros(
        3, [("x", order + "f4"), ("y", order + "f4"), ("z", order + "f4"), ("red", "u1")]
    )
    rows["red"] = RED
    body = "".join(f"0 0 0 {red}\n" for red in RED).encode() if form == "ascii" else rows.tobytes()
    with open(path, "wb") as file:
        file.write(header(form, name).encode() + body)
    mesh = meshio.read(path)
    mesh.write(f"{sys.argv[1]}/again.ply")
    with open(f"{sys.argv[1]}/again.ply", "rb") as file:
        again = [line.decode() for line in file.read(300).splitlines() if b" red" in line]
    red = mesh.point_data["red"]
    print(f"{form}, {name}: {red.dtype} {red.tolist()}; written again: {again}")
    return red.dtype == numpy.uint8 and (red == RED).all()


right = {
    (form, name): read(form, name)
    for form in ("ascii", "binary_little_endian", "binary_big_endian")
    for name in ("uchar", "uint8")
}
same = all(value == (form == "ascii" or name == "uint8") for (form, name), value in right.items())
raise SystemExit(0 if same else 1)
PYTHON
