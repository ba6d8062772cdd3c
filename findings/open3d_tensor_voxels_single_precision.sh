#!/usr/bin/env bash
# Open3D 0.20.0's tensor clouds average in single precision when they are thinned by voxels.
#
# voxel_down_sample of open3d.t.geometry.PointCloud returns the columns in their types, but their
# means are those of float32 numbers, summed in float32: for float64 positions and times, and for
# whole numbers of 64 bits. Seen for 20,000 points in voxels of 5 m at a northing of 5,400,000 m:
# means of the northing are off by up to 1.9 m, those of GPS times by up to 285 s, and that of 2^40
# + 1 and 2^40 + 3 is 2^40. Classes are averaged as other numbers: 2, 2 and 7 become 3.
# open3d.geometry.PointCloud averages float64 to a micrometre. (Its wheel wants libusb-1.0.so.0 of
# the system, which slim images lack; libusb-package has it.)
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q open3d==0.20.0 libusb-package==1.0.30.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import ctypes
import importlib.util
import pathlib

import numpy

package = pathlib.Path(importlib.util.find_spec("libusb_package").origin).parent
ctypes.CDLL(str(package / "libusb-1.0.so"), ctypes.RTLD_GLOBAL)

import open3d

SIDE = 5.0
number = 20_000
corner = numpy.array([500000.123, 5400000.456, 300.0])
points = numpy.random.default_rng(0).random((number, 3)) * [100, 100, 10] + corner
times = numpy.arange(number, dtype=numpy.float64)[:, None] + 1e9


def thinned(points, **columns):
    """Return the columns of a tensor cloud that was thinned by voxels."""
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(points))
    for name, column in columns.items():
        cloud.point[name] = open3d.core.Tensor(column)
    return {name: column.numpy() for name, column in cloud.voxel_down_sample(SIDE).point.items()}


def means(keys, column):
    """Return the mean of a column in every voxel."""
    _, inverse, counts = numpy.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return numpy.stack([numpy.bincount(inverse.ravel(), part) / counts for part in column.T], 1)


# Voxels are those of multiples of SIDE. A rounded mean can leave its voxel: each is matched to the nearest mean.
keys = numpy.floor(points / SIDE)
right = means(keys, points)
right_times = means(keys, times)
found = thinned(points, times=times)
nearest = [int(numpy.abs(right - row).sum(1).argmin()) for row in found["positions"]]
off = numpy.abs(found["positions"] - right[nearest])
late = numpy.abs(found["times"] - right_times[nearest]).max()
print(
    f"{len(found['positions'])} voxels, right: {len(right)}; types {found['positions'].dtype}, {found['times'].dtype}"
)
print(
    f"means of x, y, z are off by up to {off.max(0).round(3).tolist()} m, of times by {late:.1f} s"
)

small = numpy.array([[0.0, 0.0, 0.0], [0.1, 0.1, 0.1], [0.2, 0.2, 0.2]])
few = thinned(small[:2], big=numpy.array([[2**40 + 1], [2**40 + 3]]))["big"].item()
label = thinned(small, label=numpy.array([[2], [2], [7]], numpy.int32))["label"].item()
print(f"of 2**40 + 1 and 2**40 + 3: 2**40 + {few - 2**40}; of classes 2, 2 and 7: {label}")

plain = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)).voxel_down_sample(SIDE)
shifted = open3d.geometry.PointCloud(
    open3d.utility.Vector3dVector(points - corner)
).voxel_down_sample(SIDE)
plain, shifted = (numpy.asarray(cloud.points) for cloud in (plain, shifted))
away = max(numpy.abs(shifted - row).sum(1).min() for row in plain - corner)
print(
    f"open3d.geometry: {len(plain)} voxels, at most {away:.0e} m from those of the cloud at the origin"
)
raise SystemExit(
    0
    if 1 < off[:, 1].max() < 3 and late > 100 and few == 2**40 and label == 3 and away < 1e-6
    else 1
)
PYTHON
