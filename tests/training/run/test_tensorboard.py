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


def answer(board, address):
    with urllib.request.urlopen(f"{board}/data/plugin/{address}") as page:
        return json.load(page)


FIRST = [
    "curves/1 val accuracy, generated",
    "curves/2 val accuracy, matched",
    "curves/3 val accuracy, completed",
    "curves/7 train loss",
    "curves/8 tau",
]
"""The curves of the first screen, for a run that trains a MOPS-Net."""


def test_first_curves_are_scores_loss_and_temperature_under_short_names(board):
    tags = answer(board, "scalars/tags")

    assert set(tags) == {"run1", "run2"}  # nothing is trained in run0
    for run_name in ("run1", "run2"):
        assert sorted(tags[run_name])[: len(FIRST)] == FIRST
    every = {tag for of_run in tags.values() for tag in of_run}
    assert not {tag for tag in every if tag.startswith(("hparams", "test/"))}
    assert "epoch" not in every


def test_clouds_are_meshes_and_the_matrix_an_image_of_each_run(board):
    meshes = answer(board, "mesh/tags")
    images = answer(board, "images/tags")

    for run_name in ("run1", "run2"):
        shown = {name.partition("_")[0] for name in meshes[run_name]}
        assert shown == {"clouds/generated", "clouds/matched", "clouds/completed"}
        assert {"pictures/clouds", "pictures/matrix"} <= set(images[run_name])


def test_hparams_compare_all_runs_and_begin_with_what_differs(board):
    experiment = answer(board, "hparams/experiment?request={}")

    settings = experiment["hparamInfos"]
    differing = [one["name"] for one in settings if one["differs"]]
    assert [one["name"] for one in settings[: len(differing)]] == differing
    of_runs = [name for name in differing if not name.startswith("test/")]
    assert of_runs == ["sampler", "sampler.alpha", "sampler.tau_min"]
    assert {"net", "m", "seed", "optimizer.lr"} <= {one["name"] for one in settings}


def test_tensorboard_shows_curves_settings_images(board, opened):
    def see(address, *what):
        page, errors, requests = opened("about:blank")
        page.goto(f"{board}/{address}")
        for one in what:
            found = page.locator(one) if one == "canvas" else page.get_by_text(one)
            found.first.wait_for(state="attached")
        return page, errors, requests

    page, *_ = see("#timeseries", "canvas", FIRST[0].partition("/")[2])
    titles = page.locator("card-view .tag").all_inner_texts()  # of the cards in the window
    shown = [title.replace("\n", "") for title in titles[: len(FIRST)]]
    assert shown == FIRST[: len(shown)]
    assert len(shown) >= 3
    see("#text", "test/generated/accuracy")
    see("#hparams", "tau_min")
    see("#mesh", "canvas")  # it shows no names
    _, errors, requests = see("#images", "matrix")
    hosts = {urlparse(url).hostname for url in requests if urlparse(url).scheme.startswith("http")}
    assert hosts == {"127.0.0.1"}
    assert errors == []
