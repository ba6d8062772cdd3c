"""Small good files of every kind that the program reads, from which fuzzed ones are made."""

import io
import json
import struct
from copy import deepcopy
from typing import Any

import h5py
import numpy as np
import torch
import trimesh
from trimesh import PointCloud

from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.records import run_record
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.training.checkpoint import CHECKPOINT_KEY, sealed
from mops_lightning.viz.figures import save_clouds
from mops_lightning.zoo import weights
from tests.support.fuzz_las import copc_file, las_file, laz_with_variable_chunks
from tests.support.meshes import BOX, quantised_glb
from tests.support.mutations import flip_bits
from tests.support.records import record

SAMPLER = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 8, "sizes": [2, 4]}


LAS_FORMATS = (3, 6, 7)


PACKED = {"compression": "gzip", "chunks": (2, 20, 3)}


def seeds(folder):
    """Return the seeds by kind: the suffix and the contents of good files."""
    random = np.random.default_rng(0)
    points = random.normal(size=(40, 3))
    columns = {"intensity": random.random(40), "label": np.arange(40)}
    tables = [Table(points, columns), Table(points)]
    return {
        **_clouds(folder, tables),
        **_las_files(folder),
        **_meshes(),
        **_scans(folder, points),
        **_files_of_the_project(folder),
    }


PTX = (
    b"2\n2\n1 2 3\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n100 200 300 1\n"
    b"1 0 0 0.5 255 0 0\n0 1 0 0.25 0 255 0\n0 0 0 0.5 0 0 0\n0 0 1 1 0 0 255\n"
)

CHECKPOINT = {
    CHECKPOINT_KEY: {"trainer.max_epochs": "3", "m": "8"},
    "optimizer_states": [],
    "loops": {"fit_loop": {"epoch_progress": {"current": {"processed": 2}}}},
    "state_dict": {"task.a": torch.ones(3)},
}


def _clouds(folder, tables):
    """Return point clouds in formats without a header, or with a short one."""
    points = tables[0].points
    rows = np.zeros(40, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "i4")])
    structured = _saved(lambda file: np.save(file, rows))
    plys = _written(folder, ".ply", tables)
    ascii_plys = [
        PointCloud(points).export(file_type="ply", encoding="ascii"),
        BOX.export(file_type="ply", encoding="ascii"),
    ]
    return {
        "ply": (".ply", plys),
        "pcd": (".pcd", _written(folder, ".pcd", tables)),
        "bin": (".bin", _written(folder, ".bin", tables)),
        "npy": (".npy", [*_written(folder, ".npy", tables), structured]),
        "npz": (".npz", _written(folder, ".npz", tables)),
        "xyz": (".xyz", _written(folder, ".xyz", tables)),
        "ply ascii": (".ply", ascii_plys),
        "ply mesh": (".ply", [BOX.export(file_type="ply"), plys[0]]),
        "pcd ascii": (".pcd", [_pcd(points)]),
        "ply lists": (".ply", [_ply_with_lists()]),
        "ply packed": (".ply", [_packed_splats(folder / "packed.ply", points)]),
    }


def _las_files(folder):
    """Return LAS, LAZ and COPC files of several point formats."""
    las = [las_file(folder / "a.las", form) for form in LAS_FORMATS]
    laz = [las_file(folder / "a.laz", form) for form in LAS_FORMATS]
    copc = [copc_file(folder / "a.copc.laz", form) for form in LAS_FORMATS]
    return {
        "las": (".las", las),
        "laz": (".laz", [*laz, laz_with_variable_chunks()]),
        "copc": (".copc.laz", copc),
    }


def _meshes():
    two_boxes = trimesh.Scene([BOX, BOX.copy()])
    glbs = [
        _exported(BOX, "glb"),
        _exported(two_boxes, "glb"),
        quantised_glb(),
        quantised_glb(sparse=True),
    ]
    return {
        "off": (".off", [_exported(BOX, "off")]),
        "obj": (".obj", [_exported(BOX, "obj")]),
        "stl": (".stl", [_exported(BOX, "stl"), _exported(BOX, "stl_ascii")]),
        "glb": (".glb", glbs),
    }


def _scans(folder, points):
    """Return files of scanners, labels, splats and data sets."""
    labels = np.arange(40, dtype="<u4") << 15
    hdf5s = [_hdf5(folder / "a.h5", {}), _hdf5(folder / "a.h5", PACKED)]
    return {
        "label": (".label", [labels.tobytes()]),
        "pts": (".pts", [b"2\n1 2 3 -5 10 20 30\n4 5 6 7 8 9 10\n" * 9]),
        "ptx": (".ptx", [PTX, PTX * 2]),
        "e57": (".e57", [_e57(folder / "a.e57", points)]),
        "spz": (".spz", [_spz(folder / "a.spz", points)]),
        "hdf5": (".h5", hdf5s),
        "names": (".txt", [b"chair\ntable\nlamp\n"]),
    }


def _files_of_the_project(folder):
    """Return weights, a checkpoint, a record and saved clouds."""
    sampler = _weights(folder / "a.safetensors")
    checkpoint = sealed(_saved(lambda file: torch.save(CHECKPOINT, file)))
    run_record.write(folder, record(files={"weights": "weights.safetensors"}))
    clouds = torch.rand(2, 9, 3)
    pictured = folder / "c.npz"
    save_clouds(pictured, clouds, {"generated": clouds[:, :3]}, ["a", "b"])
    return {
        "weights": (".safetensors", [sampler]),
        "checkpoint": (".ckpt", [checkpoint]),
        "record": (".json", [(folder / run_record.FILE).read_bytes()]),
        "pictured clouds": (".npz", [pictured.read_bytes()]),
    }


def _written(folder, suffix, tables):
    path = folder / f"a{suffix}"
    contents = []
    for table in tables:
        WRITERS[suffix](path, table)
        contents.append(path.read_bytes())
    return contents


def _saved(save):
    file = io.BytesIO()
    save(file)
    return file.getvalue()


def _exported(mesh, kind):
    content = mesh.export(file_type=kind)
    return content.encode() if isinstance(content, str) else content


def _pcd(points):
    lines = [
        "VERSION 0.7",
        "FIELDS x y z",
        "SIZE 4 4 4",
        "TYPE F F F",
        "COUNT 1 1 1",
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        f"POINTS {len(points)}",
        "DATA ascii",
    ]
    for row in points:
        lines.append(" ".join(map(str, row)))
    return "\n".join(lines).encode()


def _packed_splats(path, points):
    import gsply

    gsply.plywrite(path, _splats(points), compressed=True)
    packed = path if path.exists() else path.with_name("packed.compressed.ply")
    return packed.read_bytes()


def _ply_with_lists():
    """Return a mesh of a triangle and a quad, with lists of the vertices and another element."""
    head = (
        "ply\nformat binary_little_endian 1.0\nelement camera 1\nproperty float f\n"
        "element vertex 4\nproperty double X\nproperty double Y\nproperty double Z\n"
        "property list uchar short seen\nelement face 2\nproperty uchar red\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    content = head.encode() + struct.pack("<f", 1.5)
    for row, corner in enumerate(corners):
        content += struct.pack("<3dB", *corner, row)
        content += struct.pack(f"<{row}h", *range(row))
    content += struct.pack("<BB3i", 9, 3, 0, 1, 2)
    content += struct.pack("<BB4i", 8, 4, 0, 1, 2, 3)
    return content


def _e57(path, points):
    import pye57

    data = {
        "cartesianX": points[:, 0],
        "cartesianY": points[:, 1],
        "cartesianZ": points[:, 2],
        "intensity": np.ones(len(points), np.float32),
    }
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(data, translation=np.array([1.0, 2, 3]))
        file.write_scan_raw(data)
    return path.read_bytes()


def _spz(path, points):
    import gsply

    gsply.write_spz(path, _splats(points))
    return path.read_bytes()


def _splats(points):
    import gsply

    number = len(points)
    turn = np.array([1, 0, 0, 0], np.float32)
    return gsply.GSData.from_arrays(
        means=points.astype(np.float32),
        scales=np.full((number, 3), -4, np.float32),
        quats=np.tile(turn, (number, 1)),
        opacities=np.zeros(number, np.float32),
        sh0=np.zeros((number, 3), np.float32),
        shN=np.zeros((number, 3, 3), np.float32),
    )


def _hdf5(path, options):
    with h5py.File(path, "w") as file:
        points = np.random.default_rng(0).random((6, 40, 3), "f4")
        file.create_dataset("data", data=points, **options)
        file["label"] = (np.arange(6) % 3).astype("u1")[:, None]
    return path.read_bytes()


def _weights(path):
    torch.manual_seed(0)
    config = {"learn": "sampler", "sampler": SAMPLER}
    weights.save(path, FMOPSNet(8), config, {"a": 0.5}, ["x"])
    return path.read_bytes()


def changed_content(random, content):
    """Return nested plain data with one value replaced, for what byte changes rarely reach."""
    found = list(_places(content))
    holder, key = found[random.integers(len(found))]
    value = deepcopy(ODD[random.integers(len(ODD))])
    if random.random() < 0.2 and isinstance(holder, dict):
        holder.pop(key)
    else:
        holder[key] = value
    return content


def _places(content):
    for key in list(content) if isinstance(content, dict) else range(len(content)):
        yield content, key
        if isinstance(content[key], dict | list) and content[key]:
            yield from _places(content[key])


ODD: list[Any] = [
    None,
    True,
    -1,
    0,
    3.5,
    2**70,
    float("nan"),
    1e308,
    "",
    "nan",
    "x" * 3000,
    "\ud800",
    [],
    {},
    [[[]]],
    [None],
    [1e400],
    (1, 2),
    {"_target_": "os.system"},
    {"a": {"b": 1}},
    b"x",
    torch.ones(2),
    torch.ones(()),
    "../../../etc/passwd",
]
"""Values that no file of ours holds in most places."""


def changed_glb(random, content):
    """Change the scene or the buffer of a GLB file, whose lengths stay right.

    Other changes rarely get past its JSON.
    """
    start = 20 + int.from_bytes(content[12:16], "little")
    scene = json.loads(content[20:start])
    buffer = content[start + 8 :]
    if random.random() < 0.5:
        scene = changed_content(random, scene)
    else:
        buffer = flip_bits(random, bytearray(buffer), [])
    text = json_bytes(scene)
    text += b" " * (-len(text) % 4)
    parts = _glb_part(b"JSON", text) + _glb_part(b"BIN\0", buffer)
    length = 12 + len(parts)
    return content[:8] + length.to_bytes(4, "little") + parts


def json_bytes(content):
    return json.dumps(content, default=str).encode()


def _glb_part(kind, content):
    return len(content).to_bytes(4, "little") + kind + bytes(content)
