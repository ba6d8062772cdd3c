"""The Hugging Face Hub, played by a server on this machine."""

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from mops_lightning.errors import UserError
from mops_lightning.zoo import hub

CONTENT = b"a model"
SHA256 = hashlib.sha256(CONTENT).hexdigest()
ADDRESS = "hf://owner/repo/nets/net.safetensors@sha256:"


class Hub(BaseHTTPRequestHandler):
    def do_HEAD(self):
        found = self.path == "/owner/repo/resolve/main/nets/net.safetensors"
        self.send_response(200 if found else 404)
        if found:
            self.send_header("ETag", f'"{SHA256}"')
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
        monkeypatch.setenv("HF_ENDPOINT", url)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        yield
        running.shutdown()


def test_fetch_returns_the_file_with_the_given_hash(server):
    path = hub.fetch(ADDRESS + SHA256)
    assert path.name == "net.safetensors"
    assert path.read_bytes() == CONTENT


def test_fetch_other_content_is_refused(server):
    with pytest.raises(UserError, match=f"another sha256, {SHA256}"):
        hub.fetch(ADDRESS + "0" * 64)


def test_fetch_missing_file_is_one_line(server):
    with pytest.raises(UserError, match="cannot be downloaded") as refused:
        hub.fetch(ADDRESS.replace("nets", "other") + SHA256)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "address",
    [
        "hf://owner/repo/net.safetensors",
        f"hf://owner/net.safetensors@sha256:{SHA256}",
        f"hf://owner/repo/net.pt@sha256:{SHA256}",
        f"{ADDRESS}{SHA256[1:]}",
    ],
)
def test_fetch_other_addresses_are_refused(address):
    with pytest.raises(UserError, match=r"must be hf://OWNER/REPO/FILE\.safetensors@sha256:HASH"):
        hub.fetch(address)
