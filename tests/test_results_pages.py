"""The commands on the results pages: each starts, and each table comes from its records.

The commands are read from the pages by bash, with their variables.
"""

import re
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.config.overrides import key as key_of
from mops_lightning.files.cli import compare_arguments
from mops_lightning.files.icp.tables import as_text
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report.build import build_report
from mops_lightning.report.text import markdown
from mops_lightning.training.evaluation import command_line
from mops_lightning.training.run import run as running
from mops_lightning.training.run.build import build_parts
from tests.config.test_sweep_starts import FORMS, SMALLER, without_hydra
from tests.config.test_sweeps import composed
from tests.support.small_data import POINTS, write_all

ROOT = Path(__file__).parents[1]
PAGES = sorted(ROOT.glob("results/**/README.md"))

PRINTED = """
python() { printf 'COMMAND'; printf '\\x1f%s' "$@"; printf '\\n'; }
git() { :; }
"""
"""Functions in place of commands, so that bash prints what it would call."""

ELSEWHERE = ("features",)
"""Sweeps of another commit, which their pages name."""

PLACEHOLDERS = {"M": "8", "E": "1"}
"""Numbers that a page leaves to the reader."""

TABLES_WITHOUT_COMMAND = {
    "classification_joint/dgcnn": (),
    "classification_large/n10000": (),
    "classification_large/n100000": (),
    "corruptions_128": (),
    "corruptions_fmops": (),
    "features": (),
    "own_scans/indoor": (),
    "own_scans/lidar": (),
    "reconstruction/airplane": ("nre_cd", "nre_emd"),
    "reconstruction/frameworks_1024": (),
    "reconstruction/frameworks_10000": (),
    "reconstruction/frameworks_equal": (),
    "reconstruction/scans": ("nre_cd", "nre_emd"),
    "registration/joint_full": (),
}
"""Tables beside a page's main table, with their metrics; all are made with --mixed."""


@dataclass
class Command:
    """A command of a page: its arguments behind ``python -m mops_lightning``."""

    page: str
    arguments: list[str]

    def __str__(self) -> str:
        return f"{self.page}-{'-'.join(self.arguments)}"[:150]

    @property
    def is_report(self) -> bool:
        return self.arguments[0] == "report"

    @property
    def is_comparison(self) -> bool:
        return self.arguments[0] == "compare"

    @property
    def is_run(self) -> bool:
        return not self.is_report and not self.is_comparison


def commands() -> list[Command]:
    found = []
    for page in PAGES:
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL):
            printed = subprocess.run(
                ["bash", "-c", PRINTED + block], capture_output=True, text=True, check=True
            )
            for line in printed.stdout.splitlines():
                called = line.split("\x1f")[1:]
                if called[:2] == ["-m", "mops_lightning"]:  # not a script of benchmarks/
                    found.append(Command(page.parent.name, called[2:]))
    return found


COMMANDS = commands()


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    top = tmp_path_factory.mktemp("data")
    write_all(top)
    return top


def small(arguments: list[str], roots: Path, sweep: str = "") -> list[str]:
    """Return the settings of a command with the reader's data, and as small as possible."""
    given = [_filled(argument, arguments) for argument in arguments]
    chosen = [_first(argument) for argument in given if argument is not None and argument != "-m"]
    text = " ".join(chosen)
    if "experiment=own_scans" in text:
        data = [f"dataset.root={roots}/clouds", f"dataset.cache={roots}/cache"]
    elif FORMS.get(sweep) == "airborne":
        data = [f"dataset.root={roots}/airborne", *SMALLER[sweep]]
    elif "modelnet40" in text or "evaluate=" in text or (sweep and FORMS.get(sweep) != "shapes"):
        data = [f"dataset.root={roots}/modelnet40"]
    else:
        data = ["dataset.train_per_class=1", "dataset.test_per_class=1"]
    if "dataset.n_points" in text:
        sizes = [int(one.removeprefix("m=")) for one in chosen if one.startswith("m=")]
        data.append(f"dataset.n_points={max([POINTS, *sizes])}")
    replaced = {key_of(argument) for argument in data} | {"trainer", "dataset.root"}
    if "evaluate=" in text:  # a model in place of a run on shapes
        replaced.add("dataset.train_per_class")
    kept = [argument for argument in chosen if key_of(argument) not in replaced]
    if sweep and "evaluate=" not in text and "weights=" not in text:
        data.append("weights=null")  # its first cell trains the net
    if sweep == "transfer":
        data += ["other_nets=null", "recipe.nets_per_step=null"]
    return [*kept, *data, "trainer=cpu", "logger=none", "pictures=0"]


def _filled(argument: str, arguments: list[str]) -> str | None:
    """Return an argument with a model in place of a run of the reader; None to leave it out."""
    name, _, value = argument.partition("=")
    if name == "ckpt_path":  # the reader's run
        return None
    value = PLACEHOLDERS.get(value, value)
    is_a_run = value.endswith(("RUN", "NET")) or value.startswith("outputs/")
    if not is_a_run:
        return f"{name}={value}" if "=" in argument else argument
    is_evaluation = any(one.startswith("evaluate=") for one in arguments)
    if name == "evaluate":
        several = any(one.startswith(("m=", "sizes=")) for one in arguments)
        return f"evaluate={'fmops.modelnet40-m512' if several else 'mops.modelnet40-m32'}"
    if name == "weights":
        return "weights=pointnet.modelnet40" if is_evaluation else "weights=null"
    return None


def _first(argument: str) -> str:
    """Return the first value of a swept setting."""
    name, sign, value = argument.partition("=")
    return argument if "[" in value else name + sign + value.partition(",")[0]


def _sweep(arguments: list[str]) -> str:
    """Remove the flags of a sweep's file, and return its name; empty for a command without one."""
    if "--config-name" not in arguments:
        return ""
    name = arguments[arguments.index("--config-name") + 1]
    for flag in ("--config-dir", "--config-name"):
        if flag in arguments:
            at = arguments.index(flag)
            del arguments[at : at + 2]
    return name


@pytest.mark.parametrize("command", [one for one in COMMANDS if one.is_run], ids=str)
def test_command_of_a_page_starts(command, roots, tmp_path):
    arguments = list(command.arguments)
    sweep = _sweep(arguments)
    if sweep in ELSEWHERE:
        pytest.skip("a sweep of an earlier commit")
    cfg: Any
    if sweep:
        given = command_line(small(arguments, roots, sweep))
        cfg = without_hydra(composed(sweep, tuple(given)))
    else:
        given = command_line(small(arguments, roots))
        cfg = compose(given)
    cfg = running.checked(cfg, given)
    dataset = running._load_data(cfg)
    settings: Any = OmegaConf.to_container(cfg, resolve=True)

    parts = build_parts(cfg, tmp_path, dataset, RunRecord.begin(settings, [], seed=0))

    assert parts.dataset is dataset


@pytest.mark.parametrize("command", [one for one in COMMANDS if one.is_report], ids=str)
def test_table_comes_from_its_records_by_its_command(command, monkeypatch):
    folder, *options = command.arguments[1:]
    if not folder.startswith("results/"):
        pytest.skip("the reader's runs")
    metrics = [one for one in options if one.startswith("nre_")]
    monkeypatch.chdir(ROOT)

    report = build_report(Path(folder), metrics, "--mixed" in options)

    text = markdown(report.grids, report.remarks)
    assert text == (ROOT / folder / "table.md").read_text()


@pytest.mark.parametrize("command", [one for one in COMMANDS if one.is_comparison], ids=str)
def test_comparison_of_a_page_is_understood(command):
    chosen = compare_arguments(command.arguments[1:], "compare")

    expected = "icp" if "--task" in command.arguments else "coverage"
    assert chosen.task == expected
    assert chosen.m


@pytest.mark.parametrize("record", sorted((ROOT / "results/own_scans/icp").glob("*.csv")), ids=str)
def test_table_of_registration_comes_from_its_records(record):
    text = as_text(pd.read_csv(record))

    assert text == record.with_suffix(".md").read_text()


@pytest.mark.parametrize("folder", TABLES_WITHOUT_COMMAND)
def test_further_table_comes_from_its_records(folder, monkeypatch):
    monkeypatch.chdir(ROOT)

    report = build_report(Path("results", folder), TABLES_WITHOUT_COMMAND[folder], mixed=True)

    text = markdown(report.grids, report.remarks)
    assert text == (ROOT / "results" / folder / "table.md").read_text()
