"""The numbered examples, run as their users run them, with arguments that make them short."""

import re
import runpy
import sys
from pathlib import Path

import pytest

from tests.support.command_line import SMALL_PCRNET, TINY, variables

FOLDER = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(path.name for path in FOLDER.glob("*.py"))

SHORT = {
    "01_downsample.py": ["--m", "50"],
    "02_train_in_two_minutes.py": TINY,
    "03_own_network.py": ["2"],
    "04_own_sampler.py": ["--epochs", "1"],
    "05_own_scans.py": [
        "trainer=cpu",
        "logger=none",
        "pictures=0",
        "dataset.crops=2",
        "dataset.n_points=128",
        "sampler.m_max=16",
        "sizes=[8,16]",
        "m=8",
        "recipe.train_points=64",
        "epochs.task=1",
        "epochs.sampler=1",
    ],
    "06_registration.py": [*TINY, *SMALL_PCRNET, "sampler.m_max=16", "sizes=[8,16]"],
    "07_channels.py": [
        "trainer=cpu",
        "logger=none",
        "pictures=0",
        "dataset.n_points=64",
        "sampler.m_max=8",
        "sizes=[4]",
        "m=8",
        "recipe.train_points=32",
        "epochs.task=1",
        "epochs.sampler=1",
    ],
    "08_is_it_worth_it.py": ["1"],
}
"""Arguments that make an example short, by its name."""

LAST_LINE = {
    "01_downsample.py": r"5000 points to 50, \d+% of all above the middle: torus_small.ply",
    "02_train_in_two_minutes.py": r"[\d.]+% of the test shapes from 8 points, in outputs/",
    "03_own_network.py": r"farthest points: [\d.]+% of the boxes right",
    "04_own_sampler.py": r"fps: [\d.]+% of the shapes from 16 points",
    "05_own_scans.py": r"1024 points of rooms/room_\d.ply to 8, by the sampler in outputs/",
    "06_registration.py": r"Curves and clouds: tensorboard --logdir outputs/",
    "07_channels.py": r"600 points to 8, \d+% of them on the line",
    "08_is_it_worth_it.py": r"At 8 points, best.safetensors has \w+Sampler",
}
"""What an example prints at its end, by its name."""


def test_every_example_is_tested():
    assert list(SHORT) == EXAMPLES
    assert list(LAST_LINE) == EXAMPLES


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_has_at_most_60_lines(name):
    lines = (FOLDER / name).read_text().splitlines()

    assert len(lines) <= 60


# Lightning's hints to users: there are no validation clouds, and few batches.
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_runs_to_its_last_line(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *SHORT[name]])
    for variable, value in variables(tmp_path).items():
        monkeypatch.setenv(variable, value)

    runpy.run_path(str(FOLDER / name), run_name="__main__")

    last = capsys.readouterr().out.strip().splitlines()[-1]
    assert re.match(LAST_LINE[name], last), last
