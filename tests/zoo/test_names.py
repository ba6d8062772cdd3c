import os

import pytest

from mops_lightning.errors import UserError
from mops_lightning.zoo import names

SHA256 = "0" * 64


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A folder with a file called like a model, named by MOPS_MODELS after an empty folder."""
    folder = tmp_path / "own"
    folder.mkdir()
    (folder / "fmops.mine.safetensors").touch()
    monkeypatch.setenv(names.VARIABLE, os.pathsep.join([str(tmp_path / "empty"), str(folder)]))
    monkeypatch.chdir(tmp_path)
    return folder


def test_available_lists_own_folders_before_the_package(own):
    found = names.available()
    assert list(found) == sorted(found)
    assert found["fmops.mine"] == own / "fmops.mine.safetensors"
    assert found["pointnet.modelnet40"].parent == names.SHIPPED
    (own / "pointnet.modelnet40.safetensors").touch()
    assert names.find_model("pointnet.modelnet40") == own / "pointnet.modelnet40.safetensors"


def test_first_of_two_own_folders_counts(own, tmp_path, monkeypatch):
    second = tmp_path / "second"
    second.mkdir()
    (second / "fmops.mine.safetensors").touch()
    monkeypatch.setenv(names.VARIABLE, os.pathsep.join([str(own), str(second)]))

    assert names.find_model("fmops.mine") == own / "fmops.mine.safetensors"


def test_resolve_prefers_existing_path(own, tmp_path):
    assert names.resolve("fmops.mine") == own / "fmops.mine.safetensors"
    (tmp_path / "fmops.mine").mkdir()
    assert str(names.resolve("fmops.mine")) == "fmops.mine"


@pytest.mark.parametrize("given", ["nowhere/run", "weights.safetensors", "net.safetensors"])
def test_resolve_missing_path_is_returned(given):
    assert str(names.resolve(given)) == given


@pytest.mark.parametrize("given", ["pointnet.modelnet", "pointnet-modelnet40"])
def test_resolve_unknown_name_lists_near_ones(given):
    with pytest.raises(UserError, match=r"no file or model.*Did you mean 'pointnet\.modelnet40'"):
        names.resolve(given)


def test_find_refuses_other_weights():
    assert names.find_model(f"nothing.here@sha256:{SHA256}") is None
    with pytest.raises(UserError, match=f"now has other weights than those with sha256 {SHA256}"):
        names.find_model(names.pinned("pointnet.modelnet40", SHA256))


@pytest.mark.parametrize(
    ("text", "is_name"),
    [
        ("fmops.chairs-m64", True),
        ("a.b", True),
        ("a.b.c_1", True),
        ("a", False),
        ("A.b", False),
        ("a.", False),
        ("a.pt", False),
        ("a.json", False),
        (f"a.{'b' * 98}", True),
        (f"a.{'b' * 99}", False),
    ],
)
def test_names_of_models_are_words_with_dots_of_up_to_100_letters(text, is_name):
    assert names.is_name(text) == is_name


def test_file_is_found_without_its_suffix_and_folders_below_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv(names.VARIABLE, "~/models")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "fmops.mine.safetensors").touch()
    (tmp_path / "net.safetensors").touch()

    assert str(names.resolve("net")) == "net.safetensors"
    assert names.find_model("fmops.mine") == tmp_path / "models" / "fmops.mine.safetensors"
    assert names.resolve("~/net.safetensors") == tmp_path / "net.safetensors"
