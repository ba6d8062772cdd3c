#!/usr/bin/env bash
# PyMeshLab 2025.7 simplifies clouds to more points than asked for, with exactnumflag=True, too.
#
# With exactnumflag, both generate_sampling_poisson_disk and generate_simplified_point_cloud search
# for the radius that gives the requested number of samples to 0.5 %. On a mesh it is found: 500
# gives 501. On a cloud the search does nothing: 500 of 20,000 points on a sphere become about 800, and
# of 20,000 points in a cube about 3,800, with the flag and without.
#
# Exit status 0: this still happens. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pymeshlab==2025.7.post1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy
import pymeshlab

ASKED = 500
ASKED_EXACTLY = {"samplenum": ASKED, "exactnumflag": True}

meshes = pymeshlab.MeshSet()
meshes.create_sphere(subdiv=5)
meshes.generate_sampling_poisson_disk(**ASKED_EXACTLY)
on_mesh = meshes.current_mesh().vertex_number()
print(f"asked for {ASKED} points on the mesh of a sphere: {on_mesh}")

generator = numpy.random.default_rng(0)
sphere = generator.normal(size=(20000, 3))
sphere /= numpy.linalg.norm(sphere, axis=1, keepdims=True)
cube = generator.random((20000, 3))
found = {}
for name, points in (("on a sphere", sphere), ("in a cube", cube)):
    numbers = []
    for settings in (ASKED_EXACTLY, {"samplenum": ASKED}):
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points))
        meshes.generate_simplified_point_cloud(**settings)
        numbers.append(meshes.current_mesh().vertex_number())
    found[name] = numbers[0]
    print(f"asked for {ASKED} of 20,000 points {name}: exactly {numbers[0]}, about {numbers[1]}")

same = abs(on_mesh - ASKED) <= 5
same = same and found["on a sphere"] > 1.3 * ASKED and found["in a cube"] > 5 * ASKED
raise SystemExit(0 if same else 1)
PYTHON
