"""Damaged and crafted files of every kind: read, or refused in one line.

A short round by default; ``MOPS_FUZZ=NUMBER`` tries NUMBER files of every kind (``make fuzz``).
``MOPS_FUZZ_KEEP=FOLDER`` keeps the files that failed.
"""

import json
import os
import shutil
import signal
from collections import Counter
from pathlib import Path

import pytest

from mops_lightning.data.formats import isolated
from mops_lightning.errors import UserError
from mops_lightning.zoo import model_file
from tests.support import mutations
from tests.support.fuzz_las import changed_copc
from tests.support.fuzz_readers import outcome
from tests.support.fuzz_seeds import changed_content, changed_glb, json_bytes, seeds

FILES = int(os.environ.get("MOPS_FUZZ", "12"))
KINDS = (
    "bin", "checkpoint", "copc", "copc content", "e57", "glb", "glb content", "hdf5", "label",
    "las", "laz", "names", "npy", "npz", "obj", "off", "pcd", "pcd ascii", "pictured clouds",
    "ply", "ply ascii", "ply lists", "ply mesh", "ply packed", "pts", "ptx", "record",
    "record content", "spz", "stl", "weights", "weights content", "xyz",
)  # fmt: skip

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="the system has no timer")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return seeds(tmp_path_factory.mktemp("seeds"))


@pytest.mark.parametrize("kind", KINDS)
def test_fuzzed_file_is_read_or_refused(kind, made, tmp_path, monkeypatch):
    # Longer than the limit of a parser, which is in a process of its own again.
    monkeypatch.setattr(isolated, "SECONDS", 90.0)
    suffix = made[kind.removesuffix(" content")][0]
    counts: Counter[str] = Counter()
    bad = []
    for number in range(FILES):
        # A folder each: some readers look at neighbouring files.
        path = tmp_path / str(number) / f"a{suffix}"
        path.parent.mkdir()
        content = fuzzed(kind, made, number)
        path.write_bytes(content)
        try:
            said = isolated.isolated(outcome, path, kind)
        except UserError as error:
            said = f"ended: {error}"
        shutil.rmtree(path.parent)
        counts[said if len(said) < 10 else "bad"] += 1
        if len(said) >= 10:
            bad.append(f"{kind}, file {number}: {said}")
            keep(f"{kind}-{number}{suffix}".replace(" ", "_"), content, said)
    print(f"{kind}: {dict(counts)}")
    assert not bad, f"{len(bad)} of {FILES} files:\n" + "\n".join(bad[:3])


def fuzzed(kind, made, number):
    random = mutations.generator(kind, number)
    if kind == "weights content":
        packed = made["weights"][1][0]
        end = 8 + int.from_bytes(packed[:8], "little")
        header = json.loads(packed[8:end])
        if random.random() < 0.5:
            header = changed_content(random, header)
        else:
            plain = changed_content(random, json.loads(header["__metadata__"][model_file.KEY]))
            header["__metadata__"][model_file.KEY] = json_bytes(plain).decode()
        content = json_bytes(header)
        return len(content).to_bytes(8, "little") + content + packed[end:]
    if kind == "glb content":
        scenes = made["glb"][1]
        return changed_glb(random, scenes[random.integers(len(scenes))])
    if kind == "copc content":
        files = made["copc"][1]
        return changed_copc(random, files[random.integers(len(files))])
    if kind == "record content":
        return json_bytes(changed_content(random, json.loads(made["record"][1][0])))
    others = made[kind][1]
    return mutations.mutated(random, others[random.integers(len(others))], others)


def keep(name, content, said):
    if folder := os.environ.get("MOPS_FUZZ_KEEP"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / name).write_bytes(content)
        (Path(folder) / f"{name}.said").write_text(said)
