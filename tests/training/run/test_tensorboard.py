"""TensorBoard, opened in a browser."""

import socket
import subprocess
import sys
import time
import urllib.request
from urllib.parse import urlparse

import pytest

from mops_lightning.config.compose import compose
from mops_lightning.training.run.run import run
from tests.support.command_line import TINY


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """The address of a TensorBoard that shows two small runs."""
    folder = tmp_path_factory.mktemp("board")
    logged = [one for one in TINY if not one.startswith(("pictures", "logger"))]
    overrides = [*logged, "sampler=mops", "weights=null", "pictures=3", "trainer.max_epochs=2"]
    overrides += ["val_fraction=0.2", f"cache={folder}/cache"]
    for seed in range(2):
        mine = [*overrides, f"seed={seed}"]
        run(compose(mine), folder / f"run{seed}", mine)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", folder, "--port", str(port)]
    address = f"http://127.0.0.1:{port}"
    with subprocess.Popen([*command, "--load_fast=false"], stderr=subprocess.DEVNULL) as server:
        deadline = time.monotonic() + 60
        while True:
            try:
                with urllib.request.urlopen(f"{address}/data/plugins_listing"):
                    break
            except OSError:
                assert time.monotonic() < deadline, "TensorBoard does not answer"
                time.sleep(0.2)
        yield address
        server.terminate()


def test_tensorboard_shows_curves_settings_images_meshes(board, opened):
    def see(address, *what):
        page, errors, requests = opened("about:blank")
        page.goto(f"{board}/{address}")
        for one in what:
            found = page.locator(one) if one == "canvas" else page.get_by_text(one)
            found.first.wait_for(state="attached", timeout=30_000)
        return page, errors, requests

    see("?tagFilter=mean_loss#timeseries", "mean_loss", "canvas")
    see("#text", "test/generated/accuracy")
    see("#hparams", "tau_min")
    see("#images", "matrix")
    page, errors, requests = see("#mesh", "run1/tensorboard", "canvas")
    meshes = page.locator("canvas")
    meshes.nth(1).wait_for(state="attached", timeout=30_000)  # one view for each run
    context = "(canvas.getContext('webgl2') || canvas.getContext('webgl'))"
    lost = meshes.evaluate_all(f"all => all.filter(canvas => {context}.isContextLost()).length")
    assert lost == 0, "the browser stopped drawing some"
    hosts = {urlparse(url).hostname for url in requests if urlparse(url).scheme.startswith("http")}
    assert hosts == {"127.0.0.1"}
    assert errors == []
