"""TensorBoard, by its server and in a browser."""

import json
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

RUNS = (
    ["sampler=fps"],  # has neither alpha nor tau_min, and is the first that TensorBoard reads
    ["sampler=mops", "sampler.alpha=10", "sampler.tau_min=0.1"],
    ["sampler=mops", "sampler.alpha=30", "sampler.tau_min=0.2"],
)


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """The address of a TensorBoard that shows the small runs of a sweep."""
    folder = tmp_path_factory.mktemp("board")
    logged = [one for one in TINY if not one.startswith(("pictures", "logger"))]
    overrides = [*logged, "weights=null", "pictures=1", "trainer.max_epochs=2"]
    overrides += ["val_fraction=0.2", f"cache={folder}/cache"]
    for number, own in enumerate(RUNS):
        mine = [*overrides, *own]
        run(compose(mine), folder / f"run{number}", mine)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", folder, "--port", str(port)]
    command += ["--load_fast=false", "--reload_interval=0", "--reload_task=blocking"]  # all at once
    address = f"http://127.0.0.1:{port}"
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as server:
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


def test_hparams_compare_all_runs_and_begin_with_what_differs(board):
    with urllib.request.urlopen(f"{board}/data/plugin/hparams/experiment?request={{}}") as answer:
        experiment = json.load(answer)
    settings = experiment["hparamInfos"]
    differing = [one["name"] for one in settings if one["differs"]]
    assert differing == ["names.sampler", "sampler.alpha", "sampler.tau_min"]
    assert [one["name"] for one in settings[:3]] == differing
    assert "sampler.threshold" in [one["name"] for one in settings]
    shown = [one["name"]["tag"] for one in experiment["metricInfos"][:5]]  # the first five columns
    assert "hparams/test/generated/accuracy" in shown


def test_tensorboard_shows_curves_settings_images(board, opened):
    def see(address, *what):
        page, errors, requests = opened("about:blank")
        page.goto(f"{board}/{address}")
        for one in what:
            found = page.locator(one) if one == "canvas" else page.get_by_text(one)
            found.first.wait_for(state="attached")
        return page, errors, requests

    see("?tagFilter=mean_loss#timeseries", "mean_loss", "canvas")
    see("#text", "test/generated/accuracy")
    see("#hparams", "tau_min")
    _, errors, requests = see("#images", "matrix")
    hosts = {urlparse(url).hostname for url in requests if urlparse(url).scheme.startswith("http")}
    assert hosts == {"127.0.0.1"}
    assert errors == []
