"""Models at web addresses, from a server on this machine."""

from hashlib import sha256

import pytest
import torch

from mops_lightning import downsample, load
from mops_lightning.errors import UserError
from mops_lightning.zoo import addresses, names, weights
from tests.support.served import served

NAME = "mops.modelnet40-m8-seed0.safetensors"
FILE = names.SHIPPED / NAME
DIGEST = sha256(FILE.read_bytes()).hexdigest()


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("MOPS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_load_address_downloads_once_and_equals_file():
    with served(names.SHIPPED) as (url, requested):
        address = f"{url}/{NAME}#sha256={DIGEST}"

        first = load(address)
        second = load(address)

    assert requested == [f"/{NAME}"]
    points = torch.rand(2, 64, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(first(points).points, load(FILE)(points).points)
    assert torch.equal(second(points).points, first(points).points)


def test_address_serves_samplers_and_task_nets():
    pointnet = names.SHIPPED / "pointnet.modelnet40.safetensors"
    digest = sha256(pointnet.read_bytes()).hexdigest()
    with served(names.SHIPPED) as (url, _):
        kept, indices = downsample(torch.rand(64, 3), 8, f"{url}/{NAME}#sha256={DIGEST}")
        net = weights.of_task_net(f"{url}/{pointnet.name}#sha256={digest}")

    assert kept.shape == (8, 3)
    assert indices.shape == (8,)
    assert net.read_bytes() == pointnet.read_bytes()


def test_changed_copy_in_cache_is_downloaded_again(cache):
    with served(names.SHIPPED) as (url, requested):
        address = f"{url}/{NAME}#sha256={DIGEST}"
        copy = addresses.fetch(address)
        copy.write_bytes(b"changed")

        again = addresses.fetch(address)

    assert copy.is_relative_to(cache)
    assert again.read_bytes() == FILE.read_bytes()
    assert len(requested) == 2


def test_file_with_another_hash_is_refused_and_not_kept(cache):
    wanted = "0" * 64
    with (
        served(names.SHIPPED) as (url, _),
        pytest.raises(UserError, match=f"hash.*{wanted}.*{DIGEST}"),
    ):
        load(f"{url}/{NAME}#sha256={wanted}")

    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_missing_file_names_address_and_answer():
    with served(names.SHIPPED) as (url, _), pytest.raises(UserError, match=r"nothing\.safe.*404"):
        load(f"{url}/nothing.safetensors#sha256={DIGEST}")


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("https://example.org/net.safetensors", r"must end in #sha256= and .*got none"),
        ("https://example.org/net.safetensors#sha256=12ab", "got '12ab'"),
        ("https://example.org/net.safetensors#md5=12ab", "ends in"),
        (f"https://example.org/net.pt#sha256={DIGEST}", r"ends in \.safetensors"),
    ],
)
def test_address_without_hash_or_model_is_refused(address, message):
    with pytest.raises(UserError, match=message):
        load(address)


def test_address_may_have_a_query_behind_the_name():
    url = f"https://example.org/a/{NAME}?download=true"

    address = addresses.parse(f"{url}#sha256={DIGEST}")

    assert address == (url, NAME, DIGEST)


def test_hash_may_be_in_capitals():
    url = f"https://example.org/{NAME}"

    assert addresses.parse(f"{url}#sha256={DIGEST.upper()}") == (url, NAME, DIGEST)
