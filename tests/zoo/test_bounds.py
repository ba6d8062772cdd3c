"""Files of tensors that announce more than they hold."""

import io
import pickle
import zipfile
from typing import Any

import pytest
import torch

from mops_lightning.zoo.weights import Damaged, read_plain


def nested():
    values: list[Any] = [0] * 10
    for _ in range(12):
        values = [values] * 10
    return values


@pytest.mark.parametrize(
    "content",
    [
        {"state": {"a": torch.zeros(1).expand(10**12)}},
        {"state": {str(number): torch.zeros(1000).expand(1000, 1000) for number in range(90)}},
        {"config": nested()},
    ],
    ids=["expanded tensor", "many expanded tensors", "nested lists"],
)
def test_small_file_of_large_content_is_refused(content, tmp_path):
    torch.save(content, tmp_path / "a.pt")
    with pytest.raises(Damaged, match="damaged"):
        read_plain(tmp_path / "a.pt", "a weights file")


@pytest.mark.parametrize("kind", ["zeros", "rand"])
def test_compressed_tensors_have_a_limit(kind, tmp_path):
    file = io.BytesIO()
    torch.save({"a": getattr(torch, kind)(10**6)}, file)
    with (
        zipfile.ZipFile(file) as stored,
        zipfile.ZipFile(tmp_path / "a.pt", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in stored.namelist():
            packed.writestr(name, stored.read(name))
    if kind == "rand":
        assert len(read_plain(tmp_path / "a.pt", "a weights file")["a"]) == 10**6
        return
    with pytest.raises(Damaged, match="damaged"):
        read_plain(tmp_path / "a.pt", "a weights file")


def test_tensors_that_share_bytes_are_read(tmp_path):
    values = torch.ones(10**5)
    torch.save({"a": values, "b": values, "c": values[:10]}, tmp_path / "a.pt")
    assert torch.equal(read_plain(tmp_path / "a.pt", "a weights file")["b"], values)


class Touch:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize("plain", [True, False])
def test_pickled_code_is_not_run(plain, tmp_path):
    content = {"state": Touch(tmp_path / "ran")}
    if plain:
        (tmp_path / "a.pt").write_bytes(pickle.dumps(content))
    else:
        torch.save(content, tmp_path / "a.pt")
    with pytest.raises(Damaged):
        read_plain(tmp_path / "a.pt", "a weights file")
    assert not (tmp_path / "ran").exists()
