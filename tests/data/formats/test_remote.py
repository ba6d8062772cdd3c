"""COPC files behind a server of this machine."""

import re
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.remote import local
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents, write_cloud
from tests.support.copc import write_copc
from tests.support.downsample import call, done

COARSE = Area(level=1)


class Handler(BaseHTTPRequestHandler):
    """Sends ranges of bytes; the first folder of a path says what goes wrong."""

    def __init__(self, folder, sent, *rest):
        self.folder, self.sent = folder, sent
        super().__init__(*rest)

    def do_GET(self):
        wrong, name = self.path.partition("?")[0].lstrip("/").split("/")
        if not (self.folder / name).is_file():
            self.send_error(404)
            return
        content = (self.folder / name).read_bytes()
        first, last = map(int, re.findall(r"\d+", self.headers["Range"]))
        part = content[first : last + 1]
        self.send_response(200 if wrong == "whole" else 206)
        self.send_header("Content-Range", f"bytes {first}-{last}/{len(content)}")
        self.send_header("Content-Length", str(len(part)))
        self.end_headers()
        self.wfile.write(part[:-9] if wrong == "short" else part)
        self.sent.append(len(part))

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """The address of a server, the folder of its files, and the lengths of its answers."""
    folder = tmp_path_factory.mktemp("served")
    sent: list[int] = []
    points = np.random.default_rng(0).uniform(0, 100, (150_000, 3)) * [1, 1, 0.1]
    write_copc(folder / "scan.copc.laz", points, spacing=8.0)
    write_cloud(folder / "plain.laz", points[:50])
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, folder, sent))
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", folder, sent
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("options", [["--level", 1], ["--bounds", "10,10,20,20"]])
def test_area_of_remote_file_equals_local_file(options, server, tmp_path):
    address, folder, sent = server
    options = [*options, "--method", "random", "--m", 50]
    sent.clear()
    remote = f"{address}/fine/scan.copc.laz?key=1"
    out = done(remote, tmp_path / "a.laz", *options)
    size = (folder / "scan.copc.laz").stat().st_size
    assert sum(sent) < 0.25 * size
    assert f"of {size / 1e6:,.1f} MB" in out
    assert call(folder / "scan.copc.laz", tmp_path / "b.laz", *options)[0] == 0
    one, two = (contents(tmp_path / name) for name in ("a.laz", "b.laz"))
    assert_array_equal(one.points, two.points)
    assert_array_equal(one.columns["intensity"], two.columns["intensity"])


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
    with pytest.raises(UserError, match=said) as error, local(f"{server[0]}/{path}", area):
        raise AssertionError("there is no file to read")
    assert f"{server[0]}/{path}" in str(error.value)


def test_error_about_the_copy_names_the_address(server, tmp_path):
    address = f"{server[0]}/fine/scan.copc.laz"
    options = ["--level", 0, "--method", "fps", "--m", 10_000]
    assert f"{address} holds 300 points" in call(address, tmp_path / "a.ply", *options)[2]
