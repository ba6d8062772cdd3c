"""Downloads from a local web server."""

import hashlib
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from filelock import FileLock, Timeout

from mops_lightning.data.download import fetch, one_at_a_time
from mops_lightning.errors import UserError

CONTENT = bytes(range(256)) * 2000
SHA256 = hashlib.sha256(CONTENT).hexdigest()
MD5 = hashlib.md5(CONTENT).hexdigest()


@dataclass
class Site:
    """A web server in a thread; ``behave`` says how the next requests are answered."""

    address: str
    content: bytes = CONTENT
    behave: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def url(self, path: str = "/file") -> str:
        return self.address + path


@contextmanager
def website() -> Iterator[Site]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.requests.append(self.path)
            how = state.behave.pop(0) if state.behave else "well"
            if self.path == "/missing":
                self.send_error(404)
            elif self.path == "/moved":
                self.send_response(302)
                self.send_header("Location", "/file")
                self.end_headers()
            elif how.isdigit():
                self.send_error(int(how))
            else:
                body = state.content
                self.send_response(200)
                if how != "no length":
                    self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body[: len(body) // 2] if how == "break off" else body)

        def log_message(self, *args: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        state = Site(f"http://127.0.0.1:{server.server_port}")
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield state
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def site() -> Iterator[Site]:
    with website() as served:
        yield served


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "new" / "file.zip"


def files(target: Path) -> list[str]:
    return [path.name for path in target.parent.iterdir()]


@pytest.mark.parametrize("how", ["well", "no length"])
@pytest.mark.parametrize("known_hash", [None, SHA256, SHA256.upper(), f"md5:{MD5}"])
def test_fetch_saves_only_whole_file(
    site: Site, target: Path, how: str, known_hash: str | None
) -> None:
    site.behave = [how]
    fetch([site.url()], target, known_hash)
    assert target.read_bytes() == CONTENT
    assert files(target) == [target.name]
    assert site.requests == ["/file"]


@pytest.mark.parametrize("how", ["500", "503", "break off"])
def test_fetch_temporary_failure_retries(site: Site, target: Path, how: str) -> None:
    site.behave = [how]
    fetch([site.url()], target)
    assert target.read_bytes() == CONTENT
    assert site.requests == ["/file"] * 2


def test_fetch_broken_download_leaves_nothing(site: Site, target: Path) -> None:
    site.behave = ["break off", "break off"]
    with pytest.raises(UserError, match="No mirror served"):
        fetch([site.url()], target)
    assert files(target) == []


def test_fetch_follows_redirects(site: Site, target: Path) -> None:
    fetch([site.url("/moved")], target, SHA256)
    assert target.read_bytes() == CONTENT


def test_fetch_tries_mirrors_in_turn(site: Site, target: Path) -> None:
    fetch([site.url("/missing"), site.url()], target)
    assert target.read_bytes() == CONTENT
    assert site.requests == ["/missing", "/file"]


def test_fetch_when_all_mirrors_fail_lists_their_answers(site: Site, target: Path) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound but not listening: connections are refused
        closed = f"http://127.0.0.1:{unused.getsockname()[1]}/file"
        site.behave = ["well", "500", "500"]
        with pytest.raises(UserError) as caught:
            fetch([site.url("/missing"), site.url(), closed], target)
    lines = str(caught.value).splitlines()
    assert "file.zip" in lines[0]
    assert "/missing: HTTPError: 404" in lines[1]
    assert "/file: HTTPError: 500" in lines[2]
    assert "refused" in lines[3]
    assert str(target) in lines[4]
    assert site.requests == ["/missing", "/file", "/file"]


def test_fetch_wrong_hash_moves_on_to_the_next_mirror(site: Site, target: Path) -> None:
    with website() as liar:
        liar.content = CONTENT[::-1]
        fetch([liar.url(), site.url()], target, SHA256)
        assert target.read_bytes() == CONTENT
        target.unlink()
        with pytest.raises(UserError, match=rf"hash.*expected {SHA256}"):
            fetch([liar.url()], target, SHA256)
        assert files(target) == []
        assert len(liar.requests) == 2


def test_fetch_existing_file_is_checked_and_kept(site: Site, target: Path) -> None:
    target.parent.mkdir()
    target.write_bytes(CONTENT)
    fetch([site.url()], target, SHA256)
    with pytest.raises(UserError, match=rf"exists.*{SHA256}, expected {'0' * 64}"):
        fetch([site.url()], target, "0" * 64)
    assert site.requests == []
    assert target.read_bytes() == CONTENT


def test_fetch_target_below_file_raises(site: Site, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="Cannot write"):
        fetch([site.url()], tmp_path / "file" / "file.zip")
    with (
        pytest.raises(UserError, match="Cannot download into"),
        one_at_a_time(tmp_path / "file" / ".lock"),
    ):
        pass


@pytest.mark.parametrize("urls", [[], "http://127.0.0.1/x", ["file:///etc/hosts"], ["ftp://h/x"]])
def test_fetch_without_web_addresses_is_refused(urls: Sequence[str], target: Path) -> None:
    with pytest.raises(UserError, match=r"must be a list|must start with http"):
        fetch(urls, target)


def test_fetch_misspelt_address_is_that_mirrors_answer(target: Path) -> None:
    with pytest.raises(UserError, match="No mirror served"):
        fetch(["http://127.0.0.1:x/"], target)


def test_one_at_a_time_excludes_other_threads(tmp_path: Path) -> None:
    inside, most = 0, 0

    def enter() -> None:
        nonlocal inside, most
        with one_at_a_time(tmp_path / "sub" / ".lock"):
            inside += 1
            most = max(most, inside)
            threading.Event().wait(0.01)
            inside -= 1

    threads = [threading.Thread(target=enter) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (inside, most) == (0, 1)


def test_one_at_a_time_of_a_killed_process_is_released(tmp_path: Path) -> None:
    path = tmp_path / ".lock"
    code = (
        "import sys; from pathlib import Path\n"
        "from mops_lightning.data.download import one_at_a_time\n"
        "with one_at_a_time(Path(sys.argv[1])): print(flush=True); input()\n"
    )
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(Timeout):
            FileLock(path).acquire(timeout=0)
        process.kill()
    with one_at_a_time(path):
        pass
