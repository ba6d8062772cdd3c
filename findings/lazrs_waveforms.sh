#!/usr/bin/env bash
# lazrs 0.8.2 writes wrong waveform fields to LAZ for points of formats 9 and 10 with several scanner
# channels.
#
# Points with random waveform fields and scanner channels are written by lazrs and by LASzip, both
# through laspy, and read again by both. Seen: what LASzip writes is equal in both readers; in what
# lazrs writes, six of the seven fields differ in both. (With one channel all fields are equal.)
# Formats 4 and 5, written by lazrs, are equal in lazrs and refused by LASzip ("WAVEPACKET13 has
# version > 1").
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q laspy==2.7.0 lazrs==0.8.2 laszip==0.3.0 numpy
"$folder/venv/bin/python" - <<'PYTHON'
import io
import sys

import laspy
import numpy as np
from laspy import LazBackend

FIELDS = {"wavepacket_offset", "wavepacket_size", "return_point_wave_location", "x_t", "y_t", "z_t"}


def cloud(form):
    header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.3")
    made = laspy.LasData(header)
    random = np.random.default_rng(0)
    made.x, made.y, made.z = random.random((3, 3000)) * 100
    made["wavepacket_index"] = random.integers(1, 200, 3000)
    made["wavepacket_offset"] = random.integers(0, 2**40, 3000)
    made["wavepacket_size"] = random.integers(0, 2**31, 3000)
    if form > 5:
        made.scanner_channel = random.integers(0, 4, 3000)
    for name in ("return_point_wave_location", "x_t", "y_t", "z_t"):
        made[name] = random.random(3000)
    return made


def differing(form, writer, reader):
    made, file = cloud(form), io.BytesIO()
    made.write(file, do_compress=True, laz_backend=writer)
    again = laspy.read(io.BytesIO(file.getvalue()), laz_backend=reader)
    names = made.points.array.dtype.names
    return {n for n in names if not np.array_equal(again.points.array[n], made.points.array[n])}


same = True
for form in (9, 10):
    for writer in (LazBackend.Laszip, LazBackend.Lazrs):
        for reader in (LazBackend.Laszip, LazBackend.Lazrs):
            found = differing(form, writer, reader)
            print(f"format {form}: {writer.name} -> {reader.name}: {sorted(found) or 'equal'}")
            same &= found == (FIELDS if writer == LazBackend.Lazrs else set())
for form in (4, 5):
    same &= not differing(form, LazBackend.Lazrs, LazBackend.Lazrs)
    try:
        differing(form, LazBackend.Lazrs, LazBackend.Laszip)
        same = False
    except Exception as error:
        print(f"format {form}: Lazrs -> Laszip: {error}")
        same &= "WAVEPACKET13" in str(error)
sys.exit(0 if same else 1)
PYTHON
