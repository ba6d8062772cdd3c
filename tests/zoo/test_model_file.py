import json
import struct

import pytest
import torch
from safetensors.torch import save_file

from mops_lightning.errors import UserError
from mops_lightning.zoo import model_file, names, publish
from mops_lightning.zoo.digest import digest
from tests.support.models import write_run


@pytest.fixture
def path(tmp_path):
    write_run(tmp_path / "run")
    return publish.add(tmp_path / "run", "fmops.mine", tmp_path)


def rewrite(path, card=None, state=None):
    content = model_file.read(path)
    metadata = {model_file.KEY: json.dumps({**content["card"], **(card or {})})}
    save_file({**content["state"], **(state or {})}, path, metadata)


def test_read_changed_tensors_are_refused(path):
    rewrite(path, state={"queries.weight": torch.zeros(16, 128)})
    with pytest.raises(UserError, match=r"fmops\.mine\.safetensors is damaged \(sha256"):
        model_file.read(path)


@pytest.mark.parametrize(
    "more", [{}, {"w.scale": torch.ones(3)}, {"w.scale": torch.ones(4, 1)}], ids=str
)
def test_read_8_bits_without_a_scale_for_every_row_are_refused(path, more):
    state = {"w": torch.ones(4, 2, dtype=torch.int8), **more}
    card = {"sha256": digest(state)}
    save_file(state, path, {model_file.KEY: json.dumps({**model_file.read_card(path), **card})})
    with pytest.raises(UserError, match=r"damaged or not a \.safetensors file"):
        model_file.read(path)


@pytest.mark.parametrize("size", [0, 5, 500, 50_000])
def test_read_truncated_file_is_refused(path, size):
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(UserError, match=r"damaged or not a \.safetensors file"):
        model_file.read(path)


@pytest.mark.parametrize(
    "card",
    [
        {"schema": "mops_lightning/model/2"},
        {"transform": "cube"},
        {"name": "../evil"},
        {"more": 1},
        {"record": {"config": {}}},
        {"sha256": None},
    ],
)
def test_read_other_cards_are_refused(path, card):
    rewrite(path, card=card)
    with pytest.raises(UserError, match="not a model file of this version"):
        model_file.read(path)


def test_read_card_that_is_no_json_or_missing_is_refused(path):
    state = model_file.read(path)["state"]
    for metadata in ({model_file.KEY: "{"}, {"other": "1"}, None):
        save_file(state, path, metadata)
        with pytest.raises(UserError, match=r"not a model file|damaged"):
            model_file.read_card(path)


def test_read_header_larger_than_the_file_is_refused(path):
    path.write_bytes(struct.pack("<Q", 2**40) + b"{}")
    with pytest.raises(UserError, match="damaged"):
        model_file.read_card(path)


def test_cards_are_read_without_torch():
    import subprocess
    import sys

    code = (
        "import sys; from mops_lightning.zoo import model_file, names;"
        "[model_file.read_card(path) for path in names.available().values()];"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
    assert names.available()
