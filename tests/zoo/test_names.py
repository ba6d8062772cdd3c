import hashlib
import os
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from mops_lightning.errors import UserError
from mops_lightning.zoo import names
from tests.support.models import write_run

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


def test_available_lists_own_folders_and_package(own):
    found = names.available()
    assert list(found) == sorted(found)
    assert found["fmops.mine"] == own / "fmops.mine.safetensors"
    assert found["pointnet.modelnet40"].parent == names.SHIPPED


def test_available_leaves_out_named_pipes_and_folders(own):
    os.mkfifo(own / "fmops.pipe.safetensors")
    (own / "fmops.folder.safetensors").mkdir()
    assert not {"fmops.pipe", "fmops.folder"} & set(names.available())


def test_own_model_comes_before_one_of_the_package(own):
    (own / "pointnet.modelnet40.safetensors").touch()
    assert names.find_model("pointnet.modelnet40") == own / "pointnet.modelnet40.safetensors"


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


def test_record_cannot_name_an_address(tmp_path, monkeypatch):
    from mops_lightning.zoo import weights

    address = f"hf://owner/repo/net.safetensors@sha256:{SHA256}"
    write_run(tmp_path / "run", files={"weights": address})
    monkeypatch.chdir(tmp_path / "run")
    for run in (tmp_path / "run", tmp_path / "run" / ".."):
        assert not weights.of_run(run).exists()
    with pytest.raises(UserError, match="no file"):
        weights.read(weights.of_run(tmp_path / "run"))


CONTENT = b"a model"
CONTENT_SHA256 = hashlib.sha256(CONTENT).hexdigest()
ADDRESS = "hf://owner/repo/nets/net.safetensors@sha256:"


class Hub(BaseHTTPRequestHandler):
    """The Hugging Face Hub, played by a server on this machine."""

    def do_HEAD(self):
        found = self.path == "/owner/repo/resolve/main/nets/net.safetensors"
        self.send_response(200 if found else 404)
        if found:
            self.send_header("ETag", f'"{CONTENT_SHA256}"')
            self.send_header("X-Repo-Commit", "0" * 40)
            self.send_header("Content-Length", str(len(CONTENT)))
        self.end_headers()
        return found

    def do_GET(self):
        if self.do_HEAD():
            self.wfile.write(CONTENT)

    def log_message(self, *_):
        pass


@pytest.fixture
def server(tmp_path, monkeypatch):
    constants = pytest.importorskip("huggingface_hub.constants", reason="extra hub")
    with ThreadingHTTPServer(("127.0.0.1", 0), Hub) as running:
        threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
        url = f"http://127.0.0.1:{running.server_address[1]}"
        template = f"{url}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
        monkeypatch.setattr(constants, "ENDPOINT", url)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        yield
        running.shutdown()


def test_fetch_returns_the_file_with_the_given_hash(server):
    path = names.fetch(ADDRESS + CONTENT_SHA256)
    assert path.name == "net.safetensors"
    assert path.read_bytes() == CONTENT


def test_fetch_other_content_is_refused(server):
    with pytest.raises(UserError, match=f"another sha256, {CONTENT_SHA256}"):
        names.fetch(ADDRESS + "0" * 64)


def test_fetch_missing_file_is_one_line(server):
    with pytest.raises(UserError, match="cannot be downloaded") as refused:
        names.fetch(ADDRESS.replace("nets", "other") + CONTENT_SHA256)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "address",
    [
        "hf://owner/repo/net.safetensors",
        f"hf://owner/net.safetensors@sha256:{CONTENT_SHA256}",
        f"hf://owner/repo/net.pt@sha256:{CONTENT_SHA256}",
        f"{ADDRESS}{CONTENT_SHA256[1:]}",
    ],
)
def test_fetch_other_addresses_are_refused(address):
    with pytest.raises(UserError, match=r"must be hf://OWNER/REPO/FILE\.safetensors@sha256:HASH"):
        names.fetch(address)
