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
        is_word = len(said) < 10  # "read" or "refused"
        if is_word:
            counts[said] += 1
            continue
        counts["bad"] += 1
        bad.append(f"{kind}, file {number}: {said}")
        name = f"{kind}-{number}{suffix}".replace(" ", "_")
        keep(name, content, said)
    print(f"{kind}: {dict(counts)}")
    first = "\n".join(bad[:3])
    assert not bad, f"{len(bad)} of {FILES} files:\n{first}"


def fuzzed(kind, made, number):
    random = mutations.generator(kind, number)
    _, files = made[kind.removesuffix(" content")]
    if kind == "weights content":
        return changed_weights(random, files[0])
    if kind == "record content":
        record = json.loads(files[0])
        return json_bytes(changed_content(random, record))
    file = files[random.integers(len(files))]
    if kind == "glb content":
        return changed_glb(random, file)
    if kind == "copc content":
        return changed_copc(random, file)
    return mutations.mutated(random, file, files)


def changed_weights(random, packed):
    """Change the header of a weights file: its tensors, or what it says of the model."""
    end = 8 + int.from_bytes(packed[:8], "little")
    header = json.loads(packed[8:end])
    if random.random() < 0.5:
        header = changed_content(random, header)
    else:
        metadata = header["__metadata__"]
        plain = json.loads(metadata[model_file.KEY])
        changed = json_bytes(changed_content(random, plain))
        metadata[model_file.KEY] = changed.decode()
    content = json_bytes(header)
    length = len(content).to_bytes(8, "little")
    return length + content + packed[end:]


def keep(name, content, said):
    named = os.environ.get("MOPS_FUZZ_KEEP")
    if named:
        folder = Path(named)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
        (folder / f"{name}.said").write_text(said)
