import hashlib
import re
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from mops_lightning.data.download import fetch, one_at_a_time
from mops_lightning.errors import UserError

CONTENT = bytes(range(256)) * 2000
SHA256 = hashlib.sha256(CONTENT).hexdigest()
quick = partial(fetch, pause=0.001)


@dataclass
class Site:
    """A web server in a thread; ``behave`` says how the next requests are answered."""

    address: str
    content: bytes = CONTENT
    tag: str | None = '"first"'
    behave: list[str] = field(default_factory=list)
    requests: list[tuple[str, str | None]] = field(default_factory=list)

    def url(self, path: str = "/file") -> str:
        return self.address + path

    @property
    def ranges(self) -> list[str | None]:
        return [wanted for _, wanted in self.requests]


@contextmanager
def website() -> Iterator[Site]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.requests.append((self.path, self.headers["Range"]))
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
                self.serve(how)

        def serve(self, how: str) -> None:
            body, wanted = state.content, self.headers["Range"]
            start = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1]) if wanted else 0  # type: ignore[index]
            same = self.headers["If-Range"] in (None, state.tag)
            if wanted and same and how != "ignore range":
                if start >= len(body):
                    self.send_response(416)
                    self.send_header("Content-Range", f"bytes */{len(body)}")
                    self.send_header("Content-Length", "0")
                    self.end_headers()
                    return
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
                body = body[start:]
            else:
                self.send_response(200)
            if how != "no length":
                self.send_header("Content-Length", str(len(body)))
            if state.tag:
                self.send_header("ETag", state.tag)
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


def interrupt(site: Site, target: Path) -> None:
    """Leave the first half of the file behind."""
    site.behave = ["break off"]
    with pytest.raises(UserError, match="broke off after 256000 of 512000 bytes"):
        quick([site.url()], target, tries=1)
    assert not target.exists()
    site.requests.clear()


def alone(target: Path) -> bool:
    return [path.name for path in target.parent.iterdir()] == [target.name]


@pytest.mark.parametrize("how", ["well", "no length"])
def test_a_file_arrives_whole_and_alone(site: Site, target: Path, how: str) -> None:
    site.behave = [how]
    quick([site.url()], target, sha256=SHA256.upper(), size=len(CONTENT))
    assert target.read_bytes() == CONTENT
    assert alone(target)
    assert site.ranges == [None]


def test_a_passing_failure_is_asked_again(site: Site, target: Path) -> None:
    site.behave = ["500", "503"]
    quick([site.url()], target)
    assert target.read_bytes() == CONTENT
    assert len(site.requests) == 3


def test_a_lasting_failure_sends_us_to_the_next_mirror_at_once(site: Site, target: Path) -> None:
    quick([site.url("/missing"), site.url()], target)
    assert target.read_bytes() == CONTENT
    assert [path for path, _ in site.requests] == ["/missing", "/file"]


def test_when_all_mirrors_fail_one_error_lists_what_each_answered(site: Site, target: Path) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound but not listening: connections are refused
        closed = f"http://127.0.0.1:{unused.getsockname()[1]}/file"
        site.behave = ["well", "500", "500"]
        with pytest.raises(UserError) as caught:
            quick([site.url("/missing"), site.url(), closed], target, tries=2)
    lines = str(caught.value).splitlines()
    assert "file.zip" in lines[0]
    assert "/missing: HTTP 404" in lines[1]
    assert "/file: HTTP 500" in lines[2]
    assert "asked 2 times" in lines[2]
    assert "refused" in lines[3]
    assert str(target) in lines[4]


def test_a_broken_off_download_goes_on_where_it_stopped(site: Site, target: Path) -> None:
    site.behave = ["break off", "break off"]
    quick([site.url()], target)
    assert target.read_bytes() == CONTENT
    assert site.ranges == [None, "bytes=256000-", "bytes=384000-"]


def test_a_later_call_goes_on_where_the_first_stopped(site: Site, target: Path) -> None:
    interrupt(site, target)
    quick([site.url()], target, sha256=SHA256)
    assert target.read_bytes() == CONTENT
    assert alone(target)
    assert site.ranges == ["bytes=256000-"]


def test_a_server_without_ranges_sends_all_again(site: Site, target: Path) -> None:
    interrupt(site, target)
    site.behave = ["ignore range"]
    quick([site.url()], target)
    assert target.read_bytes() == CONTENT
    assert site.ranges == ["bytes=256000-"]


@pytest.mark.parametrize("tag", ['"second"', None])
def test_halves_of_two_versions_are_never_joined(site: Site, target: Path, tag: str | None) -> None:
    interrupt(site, target)
    site.content, site.tag = CONTENT[::-1] + b"longer", tag
    quick([site.url()], target)
    assert target.read_bytes() == site.content


def test_halves_of_two_versions_are_told_apart_by_length_where_there_is_no_tag(
    site: Site, target: Path
) -> None:
    site.tag = None
    interrupt(site, target)
    site.content = CONTENT[::-1] + b"longer"
    quick([site.url()], target)
    assert target.read_bytes() == site.content
    assert site.ranges == ["bytes=256000-", None]


def test_half_a_file_from_one_mirror_is_not_finished_by_another(site: Site, target: Path) -> None:
    interrupt(site, target)
    with website() as other:
        other.content = CONTENT[::-1]
        quick([other.url()], target)
        assert target.read_bytes() == other.content
        assert other.ranges == [None]


def test_a_dead_mirror_does_not_cost_what_another_sent(site: Site, target: Path) -> None:
    interrupt(site, target)
    quick([site.url("/missing"), site.url()], target)
    assert site.ranges == [None, "bytes=256000-"]


def test_a_whole_part_needs_no_more_bytes(site: Site, target: Path) -> None:
    interrupt(site, target)
    part = target.with_name("file.zip.part")
    part.write_bytes(CONTENT)
    quick([site.url()], target)
    assert target.read_bytes() == CONTENT
    assert site.ranges == [f"bytes={len(CONTENT)}-"]


def test_a_part_longer_than_the_file_is_thrown_away(site: Site, target: Path) -> None:
    interrupt(site, target)
    target.with_name("file.zip.part").write_bytes(CONTENT + b"more")
    quick([site.url()], target)
    assert target.read_bytes() == CONTENT
    assert site.ranges[-1] is None


def test_a_spoiled_part_is_found_by_its_hash_and_fetched_afresh(site: Site, target: Path) -> None:
    interrupt(site, target)
    target.with_name("file.zip.part").write_bytes(b"spoiled")
    quick([site.url()], target, sha256=SHA256)
    assert target.read_bytes() == CONTENT
    assert site.ranges == ["bytes=7-", None]


def test_redirects_are_followed_also_when_going_on(site: Site, target: Path) -> None:
    site.behave = ["well", "break off"]
    quick([site.url("/moved")], target)
    assert target.read_bytes() == CONTENT
    assert site.requests[2:] == [("/moved", "bytes=256000-"), ("/file", "bytes=256000-")]


def test_a_wrong_hash_sends_us_to_the_next_mirror(site: Site, target: Path) -> None:
    with website() as liar:
        liar.content = CONTENT[::-1]
        quick([liar.url(), site.url()], target, sha256=SHA256)
        assert target.read_bytes() == CONTENT
        target.unlink()
        with pytest.raises(UserError, match=f"sha256 is [0-9a-f]{{64}}, expected {SHA256}"):
            quick([liar.url()], target, sha256=SHA256)
        assert not any(target.parent.iterdir())
        assert len(liar.requests) == 2


@pytest.mark.parametrize("how", ["well", "no length"])
def test_a_wrong_size_is_refused(site: Site, target: Path, how: str) -> None:
    site.behave = [how]
    with pytest.raises(UserError, match=r"512000 bytes, expected 7"):
        quick([site.url()], target, size=7)
    assert not target.exists()


def test_what_is_there_is_not_fetched_again(site: Site, target: Path) -> None:
    target.parent.mkdir()
    target.write_bytes(CONTENT)
    quick([site.url()], target, sha256=SHA256, size=len(CONTENT))
    with pytest.raises(UserError, match=r"exists, but it has 512000 bytes, expected 7"):
        quick([site.url()], target, size=7)
    assert site.requests == []
    assert target.read_bytes() == CONTENT


def test_a_place_that_cannot_be_written_is_one_error(site: Site, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="Cannot write"):
        quick([site.url()], tmp_path / "file" / "file.zip")
    with (
        pytest.raises(UserError, match="Cannot download into"),
        one_at_a_time(tmp_path / "file" / ".lock"),
    ):
        pass


@pytest.mark.parametrize("urls", [[], "http://127.0.0.1/x", ["file:///etc/hosts"], ["ftp://h/x"]])
def test_what_is_no_list_of_web_addresses_is_refused(urls: Sequence[str], target: Path) -> None:
    with pytest.raises(UserError, match=r"must be a list|must start with http"):
        quick(urls, target)


@pytest.mark.parametrize(
    "url", ["http://127.0.0.1/a b", "http://127.0.0.1:x/", "http://127.0.0.1/é"]
)
def test_a_misspelt_address_is_reported_as_that_mirror_s_answer(url: str, target: Path) -> None:
    with pytest.raises(UserError, match="No mirror served"):
        quick([url], target)


def test_only_one_at_a_time(tmp_path: Path) -> None:
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
