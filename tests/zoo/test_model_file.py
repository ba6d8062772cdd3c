import struct

import pytest
import torch
from safetensors.torch import save_file

from mops_lightning.errors import UserError
from mops_lightning.zoo import model_file, publish, weights
from tests.support.models import rewrite, write_run


@pytest.fixture
def path(tmp_path):
    write_run(tmp_path / "run")
    return publish.add(tmp_path / "run", "fmops.mine", tmp_path)


def test_read_changed_tensors_are_refused(path):
    sha256 = model_file.read_card(path)["sha256"]
    rewrite(path, {"queries.weight": torch.zeros(16, 128)}, sha256=sha256)
    with pytest.raises(model_file.Damaged, match=r"fmops\.mine\.safetensors is damaged.*sha256"):
        weights.read(path)


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
    ids=str,
)
def test_read_other_cards_are_refused(path, card):
    rewrite(path, **card)
    with pytest.raises(model_file.Damaged, match="not a file of this program"):
        weights.read(path)


def test_read_header_that_is_no_json_or_missing_or_too_large_is_refused(path):
    for metadata in ({model_file.KEY: "{"}, {model_file.KEY: "[" * 9999}, {"other": "1"}, None):
        save_file({"a": torch.ones(1)}, path, metadata)
        with pytest.raises(model_file.Damaged):
            model_file.read_card(path)
    for size in (2**40, 10**7):
        path.write_bytes(struct.pack("<Q", size) + b"{}".ljust(10**7))
        with pytest.raises(model_file.Damaged):
            model_file.read_card(path)


def test_read_card_of_weights_of_a_run_is_refused(path, tmp_path):
    with pytest.raises(UserError, match=r"holds the weights of a run.*models add"):
        model_file.read_card(tmp_path / "run" / weights.FILE)
