import gc
import os

if "PYTEST_XDIST_WORKER" in os.environ:
    # Workers share the cores; what they start inherits this. Read once, when torch is imported.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import random
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.kept_choices import keep_choices

if "OMP_NUM_THREADS" not in os.environ:
    torch.set_num_threads(2)

# Composing makes many objects, and each full collection would search all of torch.
gc.freeze()
gc.set_threshold(50_000, 20, 50)
keep_choices()


SLOW_FILES = (
    "training/run/test_tensorboard",
    "config/test_sweeps",
    "config/test_validate",
    "zoo/test_at_once",
    "zoo/test_export",
    "config/test_sweep_starts",
    "samplers/test_contract",
    "docs/test_notebooks",
    "cli/test_sweep",
    "training/run/test_pretrain",
    "training/run/test_load",
    "training/test_checkpoint",
    "training/test_precision",
    "samplers/test_memory",
    "cli/test_ended",
    "hydra_plugins/test_grid_sweeper",
    "config/test_distributed",
    "files/test_engine",
    "test_wheel",
    "cli/test_train",
    "cli/test_launchers",
    "docs/test_site",
    "files/test_batch",
    "report/test_page",
    "cli/test_main",
    "config/test_groups",
    "data/test_scans_of_shapes",
    "docs/test_own_network",
    "examples/test_examples",
    "data/test_different_sizes",
    "zoo/test_models",
    "tasks/test_contract",
    "fuzz/test_command_lines",
    "training/test_evaluation",
    "config/test_compose",
    "cli/test_resume",
    "docs/test_extend",
    "training/recipe/test_warm_start",
    "training/run/test_run",
    "training/run/test_build",
)
"""The files that take longest. They begin first, or one process would end alone with one.

The first one compiles the loops that most tests need, and keeps them in files. The second and the
third need none, and the next one compiles its own.
"""


LIBRARIES = ("torch", "lightning", "hydra-core", "omegaconf", "torchmetrics", "numpy", "pandas")
"""Libraries whose versions decide most often whether the tests pass."""


def pytest_report_header() -> str:
    """Return the line that says with which versions the tests ran."""
    return "libraries: " + ", ".join(f"{name} {version(name)}" for name in LIBRARIES)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files: slow ones, then the rest; with several processes, each takes the next."""
    tests = Path(__file__).parent

    def rank(item: pytest.Item) -> int:
        name = item.path.relative_to(tests).with_suffix("").as_posix()
        return SLOW_FILES.index(name) if name in SLOW_FILES else len(SLOW_FILES)

    items.sort(key=rank)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Seed the global generators: which tests ran before in this process depends on the machine."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002  libraries use it
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def real_data() -> Callable[[str], Path]:
    """A function that finds real data below the folder that the user names, or skips the test."""

    def find(name: str) -> Path:
        path = Path(os.environ.get("MOPS_DATA", "MOPS_DATA")) / name
        if not path.exists():
            pytest.skip(f"{path} is not there: no real data to test on")
        return path

    return find


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def randn(rng: torch.Generator) -> Callable[..., torch.Tensor]:
    """``torch.randn`` with the generator of the test."""
    return partial(torch.randn, generator=rng)


@pytest.fixture
def rand(rng: torch.Generator) -> Callable[..., torch.Tensor]:
    """``torch.rand`` with the generator of the test."""
    return partial(torch.rand, generator=rng)


PATIENCE = 120_000
"""Milliseconds that a browser may take on a busy machine, where its own limit is 30,000."""
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
        launch = playwright.chromium.launch
        yield launch(executable_path=program, args=flags, timeout=PATIENCE)


@pytest.fixture
def opened(browser: Any) -> Iterator[Any]:
    """A function that opens an address: the page, its errors, and all addresses it asked for."""
    yield from opening(browser)


@pytest.fixture(scope="module")
def opened_once(browser: Any) -> Iterator[Any]:
    """The same with one page for all tests of a file."""
    yield from opening(browser)


def opening(browser: Any) -> Iterator[Any]:
    """Yield the function of ``opened``."""
    page = browser.new_page()
    page.set_default_timeout(PATIENCE)
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
