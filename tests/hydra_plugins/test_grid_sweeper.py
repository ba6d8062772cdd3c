"""Several grids in one command, as a user starts it."""

import json

import pytest

from tests.support.command_line import TINY, call

PLAN = """\
defaults:
  - config
  - override hydra/sweeper: grid
  - _self_

weights: null

hydra:
  mode: MULTIRUN
  sweep:
    dir: cells
    subdir: ${names.sampler}-m${m}
  sweeper:
    params: {seed: 3, sampler: random}
    grids:
      - {m: "4,8"}
      - {sampler: fps, m: 16, seed: 4}
"""

COMMAND = ["-m", "--config-dir=.", "--config-name=plan", *(one for one in TINY if one != "m=8")]


def start(folder, *arguments):
    """Start the plan; its cells by name, in the order of their jobs, and what was printed."""
    (folder / "plan.yaml").write_text(PLAN)
    status, out, err = call([*COMMAND, *arguments], folder)
    jobs = {}
    for path in (folder / "cells").glob("*/.hydra/hydra.yaml"):
        number = int(path.read_text().split("\n    num: ")[1].split("\n")[0])
        jobs[number] = path.parents[1].name
    return status, [jobs[number] for number in sorted(jobs)], out, err


def record(folder, cell):
    return json.loads((folder / "cells" / cell / "result.json").read_text())


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """The folder of the plan, and how it was run."""
    folder = tmp_path_factory.mktemp("plan")
    return folder, start(folder)


def test_grids_run_one_after_the_other_and_win_over_params(plan):
    folder, (status, cells, out, err) = plan
    assert status == 0, out + err
    assert cells == ["random-m4", "random-m8", "fps-m16"]
    assert [record(folder, cell)["config"]["seed"] for cell in cells] == [3, 3, 4]
    assert "3 cells: 3 completed; in cells" in out


def test_grids_command_line_wins_over_every_grid_and_values_may_be_null_and_lists(tmp_path):
    grids = "hydra.sweeper.grids=[{sampler:random,sizes:[2,6],weights:null},{sampler:fps,m:4}]"
    status, cells, out, err = start(tmp_path, "m=2", grids)
    assert status == 0, out + err
    assert cells == ["random-m2", "fps-m2"]
    config = record(tmp_path, "random-m2")["config"]
    assert (config["sizes"], config["weights"]) == ([2, 6], None)


def test_grids_repeated_command_runs_missing_cells_only(plan):
    folder, _ = plan
    kept = {cell: record(folder, cell) for cell in ("random-m4", "fps-m16")}
    (folder / "cells" / "random-m8" / "result.json").unlink()
    status, cells, out, err = start(folder)
    assert status == 0, out + err
    assert cells == ["random-m4", "random-m8", "fps-m16"]
    assert {cell: record(folder, cell) for cell in kept} == kept
    assert record(folder, "random-m8")["status"] == "completed"


@pytest.mark.parametrize(
    ("grids", "message"),
    [
        ("[]", "hydra.sweeper.grids must be a list of mappings, got []."),
        ("[{m:4},5]", "hydra.sweeper.grids[1] must be a mapping, got 5."),
        ("[{m:4},{m:'8,,3'}]", "hydra.sweeper.grids[1]: cannot read m=8,,3. Give"),
        ("[{m:4},{sampler.alfa:3}]", "sampler.alfa: no such setting. Did you mean"),
    ],
)
def test_grids_mistake_is_one_line_before_any_cell(grids, message, tmp_path):
    status, cells, out, err = start(tmp_path, f"hydra.sweeper.grids={grids}")
    assert status == 2
    assert message in err
    assert len(err.splitlines()) == 1
    assert cells == []


def test_sweep_may_report_runs_of_different_settings_in_one_table(tmp_path):
    grids = "hydra.sweeper.grids=[{sampler:mops,m:4},{sampler:mops,m:8,optimizer.lr:0.01}]"
    _, _, out, _ = start(tmp_path, grids)
    assert "2 groups of runs are not comparable" in out
    _, _, out, _ = start(tmp_path, grids, "hydra.callbacks.summary.mixed=true")
    assert "| m=8 | m=4 |" in out
