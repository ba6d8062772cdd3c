import os

if "PYTEST_XDIST_WORKER" in os.environ:
    # Workers share the cores; what they start inherits this. Read once, when torch is imported.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch

from mops_lightning.data.clouds import CloudDataset, Clouds

if "OMP_NUM_THREADS" not in os.environ:
    torch.set_num_threads(2)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real data that the user names; tests on it are skipped without one."""
    folder = os.environ.get("MOPS_DATA")
    if not folder:
        pytest.skip("MOPS_DATA is not set: no real data to test on")
    return Path(folder)


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def quiet_trainer(epochs: int, **extra: Any) -> L.Trainer:
    """A CPU trainer that writes and prints nothing."""
    return L.Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        **extra,
    )


def small_dataset(train: int = 24, test: int = 10, points: int = 48) -> CloudDataset:
    """Three kinds of Gaussian blobs: enough to run every code path, too easy to measure with."""
    rng = torch.Generator().manual_seed(3)

    def clouds(number: int) -> Clouds:
        labels = torch.arange(number) % 3
        scale = torch.tensor([[1.0, 0.1, 0.1], [0.1, 1.0, 0.1], [0.3, 0.3, 0.3]])[labels]
        return Clouds(torch.randn(number, points, 3, generator=rng) * scale[:, None], labels)

    return CloudDataset(("long", "tall", "round"), clouds(train), clouds(test), "blobs")


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """An installed Chromium, without a window."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser to look with: none of {', '.join(BROWSERS)} is installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # WebGL without a graphics card.
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        yield playwright.chromium.launch(executable_path=program, args=flags)


@pytest.fixture
def opened(browser: Any) -> Iterator[Any]:
    """A function that opens an address: the page, its errors, and all addresses it asked for."""
    page = browser.new_page()
    errors: list[str] = []
    requests: list[str] = []

    def note(message: Any) -> None:
        if message.type == "error":
            errors.append(message.text)

    page.on("console", note)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))

    def open_(address: str) -> tuple[Any, list[str], list[str]]:
        page.goto(address)
        return page, errors, requests

    yield open_
    page.close()
