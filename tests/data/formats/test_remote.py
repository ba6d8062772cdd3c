"""COPC files behind a server of this machine."""

import re
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.registry import read
from mops_lightning.data.formats.remote import local
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import uniform_points
from tests.support.copc import write_copc
from tests.support.downsample import call, done

COARSE = Area(level=1)


class Handler(BaseHTTPRequestHandler):
    """Sends ranges of bytes; the first folder of a path says what goes wrong."""

    def __init__(self, folder, sent, *rest):
        self.folder = folder
        self.sent = sent
        super().__init__(*rest)

    def do_GET(self):
        address, _, _ = self.path.partition("?")
        wrong, name = address.lstrip("/").split("/")
        file = self.folder / name
        if not file.is_file():
            self.send_error(404)
            return
        content = file.read_bytes()
        first, last = map(int, re.findall(r"\d+", self.headers["Range"]))
        part = content[first : last + 1]
        status = 206
        if wrong == "whole":
            status = 200
        self.send_response(status)
        self.send_header("Content-Range", f"bytes {first}-{last}/{len(content)}")
        self.send_header("Content-Length", str(len(part)))
        self.end_headers()
        self.sent.append(len(part))
        if wrong == "short":
            part = part[:-9]
        self.wfile.write(part)

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """The address of a server, the folder of its files, and the lengths of its answers."""
    folder = tmp_path_factory.mktemp("served")
    sent: list[int] = []
    points = uniform_points(150_000, 0) * [100, 100, 10]
    write_copc(folder / "scan.copc.laz", points, spacing=8.0)
    write_cloud(folder / "plain.laz", points[:50])
    handler = partial(Handler, folder, sent)
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", folder, sent
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("options", [["--level", 1], ["--bounds", "10,10,20,20"]])
def test_area_of_remote_file_equals_local_file(options, server, tmp_path):
    address, folder, sent = server
    options = [*options, "--method", "random", "--m", 50]
    remote = f"{address}/fine/scan.copc.laz?key=1"
    local_file = folder / "scan.copc.laz"
    of_remote = tmp_path / "a.laz"
    of_local = tmp_path / "b.laz"
    sent.clear()

    out = done(remote, of_remote, *options)
    done(local_file, of_local, *options)

    size = local_file.stat().st_size
    assert sum(sent) < 0.25 * size
    assert f"reading {sum(sent) / 1e6:,.1f} of {size / 1e6:,.1f} MB" in out
    found = contents(of_remote)
    expected = contents(of_local)
    assert_array_equal(found.points, expected.points)
    assert_array_equal(found.columns["intensity"], expected.columns["intensity"])


def test_file_whose_records_take_more_than_the_first_bytes_is_read(server, monkeypatch):
    address, folder, _ = server
    monkeypatch.setattr("mops_lightning.data.formats.remote.HEAD", 400)  # the points begin later

    with local(f"{address}/fine/scan.copc.laz", COARSE) as path:
        found = read(path, 1, 0, COARSE)

    expected = read(folder / "scan.copc.laz", 1, 0, COARSE)
    assert_array_equal(found.points, expected.points)


def test_remote_file_in_capitals_is_read(server):
    address, folder, _ = server
    content = (folder / "scan.copc.laz").read_bytes()
    (folder / "SCAN.COPC.LAZ").write_bytes(content)

    with local(f"{address}/fine/SCAN.COPC.LAZ", COARSE) as path:
        found = read(path, 1, 0, COARSE)

    assert len(found.points) > 300


@pytest.mark.parametrize(
    ("path", "area", "said"),
    [
        ("fine/scan.copc.laz", None, "give --bounds, --level or --resolution"),
        ("fine/scan.las", COARSE, "must be a .copc.laz file"),
        ("fine/plain.laz", COARSE, "plain.laz is not a COPC file"),
        ("fine/none.laz", COARSE, "404"),
        ("whole/scan.copc.laz", COARSE, "sends whole files only"),
        ("short/scan.copc.laz", COARSE, "sent 9 bytes too few"),
    ],
)
def test_remote_file_that_cannot_be_read_by_areas_is_named(path, area, said, server):
    address, _, _ = server
    remote = f"{address}/{path}"

    with pytest.raises(UserError, match=said) as error, local(remote, area):
        raise AssertionError("there is no file to read")

    assert remote in str(error.value)


def test_error_about_the_copy_names_the_address(server, tmp_path):
    address, _, _ = server
    remote = f"{address}/fine/scan.copc.laz"
    options = ["--level", 0, "--method", "fps", "--m", 10_000]

    _, _, said = call(remote, tmp_path / "a.ply", *options)

    assert f"{remote} holds 300 points" in said
