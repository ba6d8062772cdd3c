"""Random command lines: each is a completed tiny run, or ends in one line.

A short round by default; ``MOPS_FUZZ=NUMBER`` tries NUMBER of them (``make fuzz``).
"""

import os
import shutil
import traceback
from collections import Counter
from typing import Any

import pytest
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.tree import dotted
from tests.support.command_line import TINY, call

hypothesis = pytest.importorskip("hypothesis", reason="hypothesis is in the extra test")
from hypothesis import strategies as st  # noqa: E402

LINES = int(os.environ.get("MOPS_FUZZ", "2"))

GROUPS = {
    "sampler": (
        "mops",
        "fmops",
        "snet",
        "samplenet",
        "samplenet_progressive",
        "fps",
        "random",
        "voxel",
        "poisson",
        "serial",
        "normal_space",
        "covariance",
        "information",
        "steady",
    ),
    "task": ("classification", "registration", "reconstruction"),
    "task/net": ("pointnet", "pcrnet", "autoencoder", "foldingnet", "atlasnet"),
    "optimizer": ("one_cycle", "exponential", "step_decay", "one_cycle_snet", "muon"),
    "logger": ("none", "csv"),
    "trainer": ("auto", "cpu"),
    "learn": ("task", "sampler", "joint", "nothing"),
    "weights": ("auto", "null"),
    "dataset": ("shapes", "scans_of_shapes", "modelnet40", "meshes", "hdf5"),
}

# No number makes a run longer or larger than a test can wait for.
VALUES = (
    "-1",
    "0",
    "1",
    "2",
    "3",
    "8",
    "0.5",
    "-0.5",
    "1e-3",
    "1e30",
    "-1e30",
    "1e400",
    "nan",
    "inf",
    "-inf",
    "9223372036854775808",
    "true",
    "null",
    "abc",
    "''",
    "[]",
    "[1,2]",
    "[nan]",
    "{}",
    "{a:1}",
    "'5'",
    "nowhere/x",
    "/proc/x",
    "n" * 300,
    "${m}",
    "${nosuch}",
    "???",
    "é",
    "a=b",
)
LEFT_OUT = ("trainer.devices", "trainer.strategy", "names.", "_target_")
"""Settings that start further processes or are derived."""


def settings():
    """Every dotted setting of the groups, with its value."""
    found: dict[str, Any] = {}
    for group in ("sampler", "task", "optimizer"):
        for choice in GROUPS[group]:
            composed = compose([*TINY, f"{group}={choice}"])
            found |= dotted(OmegaConf.to_container(composed, resolve=True))
    return {key: found[key] for key in sorted(found) if not any(one in key for one in LEFT_OUT)}


def near(value):
    """Return values of the same type, most of which are right."""
    if isinstance(value, bool):
        return [str(not value).lower()]
    if isinstance(value, int):
        return [str(number) for number in (value, value + 1, max(value // 2, 1))]
    if isinstance(value, float):
        return [repr(number) for number in (value, value / 2, value * 3, value + 0.1)]
    return ["null"]


def command_lines():
    known = settings()
    group = st.sampled_from(sorted(GROUPS)).flatmap(
        lambda name: st.sampled_from([f"{name}={one}" for one in GROUPS[name]])
    )
    right = st.sampled_from(sorted(known)).flatmap(
        lambda key: st.sampled_from([f"{key}={value}" for value in near(known[key])])
    )
    wrong = st.builds(
        lambda sign, key, value: f"~{key}" if sign == "~" else f"{sign}{key}={value}",
        st.sampled_from(["", "", "", "", "", "+", "++", "~"]),
        st.sampled_from([*known, *GROUPS, "nosuch", "sampler.nosuch", "m.x", "trainer.min_epochs"]),
        st.sampled_from(VALUES),
    )
    few = st.lists(st.one_of(group, right), max_size=3)
    return st.tuples(few, st.lists(wrong, max_size=1)).map(lambda both: both[0] + both[1])


def outcome(arguments, folder):
    """Return the exit status of a command line, and what is wrong with it; "" for nothing."""
    start = [*TINY, f"cache={folder}/shared"]
    place = folder / "place"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    try:
        status, out, err = call([*start, *arguments, "hydra.run.dir=run"], place)
    except BaseException:
        return 1, traceback.format_exc()[-1500:]
    if status == 0:
        good = (place / "run" / "result.json").exists()
    else:
        good = status == 2 and err.count("\n") == 1 and err.startswith("mops_lightning: ")
    return status, "" if good and "Traceback" not in out else f"{out[-500:]}{err[-1500:]}"


@pytest.mark.filterwarnings("default")
def test_random_command_line_runs_or_ends_in_one_line(tmp_path):
    faults: list[str] = []
    tried: Counter[int] = Counter()

    @hypothesis.settings(
        max_examples=LINES,
        derandomize="MOPS_FUZZ" not in os.environ,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(command_lines())
    def attempt(arguments):
        status, said = outcome(arguments, tmp_path)
        tried[status] += 1
        if said:
            faults.append(f"{arguments}: {said}")
            print(f"after {tried.total()}: {faults[-1]}", flush=True)
        if tried.total() % 25 == 0:
            print(f"{tried.total()} tried, {tried[0]} completed, {len(faults)} faults", flush=True)

    attempt()
    print(f"{tried.total()} command lines, {tried[0]} completed, {len(faults)} faults")
    assert LINES < 100 or (tried[0] and tried[2])
    assert faults == []
