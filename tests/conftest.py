import os

if "PYTEST_XDIST_WORKER" in os.environ:
    # Workers share the cores; what they start inherits this. Read once, when torch is imported.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

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
