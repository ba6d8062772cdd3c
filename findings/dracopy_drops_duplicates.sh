#!/usr/bin/env bash
# DracoPy 2.2.0 leaves out points that are equal, and changes the order of the others.
#
# encode(points) of a cloud, with its default preserve_order=False, keeps one of several points with
# the same coordinates, so that labels or intensities beside the file fit neither in number nor in
# order. Its help speaks of the order only. Seen: of 1,500 points, 500 of them twice, 1,000 are
# decoded; with preserve_order=True all 1,500, in their order. Points that become the same only by
# the quantisation (14 bits by default) are all kept. Decoded coordinates are float32, for float64
# input with 30 bits, too: at a northing of 5,400,000 m they are off by up to 0.25 m.
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q DracoPy==2.2.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import DracoPy
import numpy

points = numpy.random.default_rng(0).random((1000, 3)).astype(numpy.float32)
twice = numpy.concatenate([points, points[:500]])
numbers = {
    order: len(DracoPy.decode(DracoPy.encode(twice, preserve_order=order)).points)
    for order in (False, True)
}
print(
    f"of {len(twice)} points, {numbers[False]} are decoded; with preserve_order=True {numbers[True]}"
)

close = (numpy.arange(1000)[:, None] * numpy.float32([1e-6, 0, 0])).astype(numpy.float32)
close = numpy.concatenate([close, numpy.float32([[1, 1, 1]])])
kept = numpy.asarray(DracoPy.decode(DracoPy.encode(close)).points)
different = len(numpy.unique(kept, axis=0))
print(f"of {len(close)} close points, {len(kept)} are decoded, {different} of them different")

decoded = numpy.asarray(DracoPy.decode(DracoPy.encode(points)).points)
steps = numpy.abs(decoded - points).max()
print(f"row by row, coordinates differ by up to {steps:.2f} in a cube of 1")

maps = points.astype(numpy.float64) * [100, 100, 10] + [500000.123, 5400000.456, 300.0]
decoded = numpy.asarray(
    DracoPy.decode(DracoPy.encode(maps, quantization_bits=30, preserve_order=True)).points
)
error = numpy.abs(decoded - maps).max()
print(f"map coordinates with 30 bits: {decoded.dtype}, off by up to {error:.3f} m")
same = numbers == {False: 1000, True: 1500} and len(kept) == len(close) > different
raise SystemExit(0 if same and steps > 0.5 and 0.2 < error < 0.3 else 1)
PYTHON
