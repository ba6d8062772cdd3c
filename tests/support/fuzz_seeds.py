"""Small good files of every kind that the program reads, from which fuzzed ones are made."""

import io
import json
import struct
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


def seeds(folder):
    """Return the seeds by kind: the suffix and the contents of good files."""
    random = np.random.default_rng(0)
    points = random.normal(size=(40, 3))
    columns = {"intensity": random.random(40), "label": np.arange(40)}
    tables = Table(points, columns), Table(points)
    made = {
        kind: (suffix, [_written(folder, suffix, table) for table in tables])
        for kind, suffix in (("ply", ".ply"), ("pcd", ".pcd"), ("bin", ".bin"), ("npy", ".npy"),
                             ("npz", ".npz"), ("xyz", ".xyz"))
    }  # fmt: skip
    rows = np.zeros(40, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "i4")])
    made["npy"][1].append(_saved(lambda file: np.save(file, rows)))
    in_ascii = {"file_type": "ply", "encoding": "ascii"}
    made["ply ascii"] = (".ply", [one.export(**in_ascii) for one in (PointCloud(points), BOX)])
    made["ply mesh"] = (".ply", [BOX.export(file_type="ply"), made["ply"][1][0]])
    made["pcd ascii"] = (".pcd", [_pcd(points)])
    for suffix in (".las", ".laz"):
        made[suffix[1:]] = (suffix, [las_file(folder / f"a{suffix}", form) for form in (3, 6, 7)])
    for suffix in (".off", ".obj", ".stl", ".glb"):
        made[suffix[1:]] = (suffix, [_bytes(BOX.export(file_type=suffix[1:]))])
    made["stl"][1].append(_bytes(BOX.export(file_type="stl_ascii")))
    made["glb"][1].append(_bytes(trimesh.Scene([BOX, BOX.copy()]).export(file_type="glb")))
    made["laz"][1].append(laz_with_variable_chunks())
    made["copc"] = (".copc.laz", [copc_file(folder / "a.copc.laz", form) for form in (3, 6, 7)])
    made["ply lists"] = (".ply", [_ply_with_lists()])
    made["ply packed"] = (".ply", [_packed_splats(folder / "packed.ply", points)])
    made["label"] = (".label", [(np.arange(40, dtype="<u4") << 15).tobytes()])
    made["pts"] = (".pts", [b"2\n1 2 3 -5 10 20 30\n4 5 6 7 8 9 10\n" * 9])
    made["ptx"] = (".ptx", [PTX, PTX * 2])
    made["e57"] = (".e57", [_e57(folder / "a.e57", points)])
    made["spz"] = (".spz", [_spz(folder / "a.spz", points)])
    made["glb"][1].extend([quantised_glb(), quantised_glb(sparse=True)])
    packed = {"compression": "gzip", "chunks": (2, 20, 3)}
    made["hdf5"] = (".h5", [_hdf5(folder / "a.h5", options) for options in ({}, packed)])
    made["names"] = (".txt", [b"chair\ntable\nlamp\n"])
    made["weights"] = (".safetensors", [_weights(folder / "a.safetensors")])
    made["checkpoint"] = (".ckpt", [sealed(_saved(lambda file: torch.save(CHECKPOINT, file)))])
    run_record.write(folder, record(files={"weights": "weights.safetensors"}))
    made["record"] = (".json", [(folder / run_record.FILE).read_bytes()])
    clouds = torch.rand(2, 9, 3)
    save_clouds(folder / "c.npz", clouds, {"generated": clouds[:, :3]}, ["a", "b"])
    made["pictured clouds"] = (".npz", [(folder / "c.npz").read_bytes()])
    return made


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


def _written(folder, suffix, table):
    WRITERS[suffix](folder / f"a{suffix}", table)
    return (folder / f"a{suffix}").read_bytes()


def _saved(save):
    file = io.BytesIO()
    save(file)
    return file.getvalue()


def _bytes(content):
    return content.encode() if isinstance(content, str) else content


def _pcd(points):
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA ascii\n"
    )
    return (head + "\n".join(" ".join(map(str, row)) for row in points)).encode()


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
    vertices = [
        struct.pack("<3dB", *corner, row) + struct.pack(f"<{row}h", *range(row))
        for row, corner in enumerate(corners)
    ]
    faces = struct.pack("<BB3i", 9, 3, 0, 1, 2) + struct.pack("<BB4i", 8, 4, 0, 1, 2, 3)
    return head.encode() + struct.pack("<f", 1.5) + b"".join(vertices) + faces


def _e57(path, points):
    import pye57

    axes = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T, strict=True))
    data = {**axes, "intensity": np.ones(len(points), np.float32)}
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

    return gsply.GSData.from_arrays(
        means=points.astype(np.float32),
        scales=np.full((len(points), 3), -4, np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(points), 1)),
        opacities=np.zeros(len(points), np.float32),
        sh0=np.zeros((len(points), 3), np.float32),
        shN=np.zeros((len(points), 3, 3), np.float32),
    )


def _hdf5(path, options):
    with h5py.File(path, "w") as file:
        points = np.random.default_rng(0).random((6, 40, 3), "f4")
        file.create_dataset("data", data=points, **options)
        file["label"] = (np.arange(6) % 3).astype("u1")[:, None]
    return path.read_bytes()


def _weights(path):
    torch.manual_seed(0)
    weights.save(path, FMOPSNet(8), {"learn": "sampler", "sampler": SAMPLER}, {"a": 0.5}, ["x"])
    return path.read_bytes()


def changed_content(random, content):
    """Return nested plain data with one value replaced, for what byte changes rarely reach."""
    found = list(_places(content))
    holder, key = found[random.integers(len(found))]
    odd: list[Any] = [
        None, True, -1, 0, 3.5, 2**70, float("nan"), 1e308, "", "nan", "x" * 3000, "\ud800",
        [], {}, [[[]]], [None], [1e400], (1, 2), {"_target_": "os.system"}, {"a": {"b": 1}},
        b"x", torch.ones(2), torch.ones(()), "../../../etc/passwd",
    ]  # fmt: skip
    value = odd[random.integers(len(odd))]
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
    parts = [
        len(part).to_bytes(4, "little") + kind + bytes(part)
        for kind, part in ((b"JSON", text), (b"BIN\0", buffer))
    ]
    length = 12 + sum(map(len, parts))
    return content[:8] + length.to_bytes(4, "little") + b"".join(parts)


def json_bytes(content):
    return json.dumps(content, default=str).encode()
