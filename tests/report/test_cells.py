import pytest

from mops_lightning.errors import UserError
from tests.support.reports import put, put_cell, rows, table


def test_cells_run_of_many_sizes_fills_columns(tmp_path):
    metrics = {"test/full/accuracy": 0.9}
    for m in (8, 32):
        metrics |= {f"test/m{m}/{name}/accuracy": m / 100 for name in ("generated", "matched")}
        metrics |= {f"test/m{m}/fps/accuracy": m / 200, f"test/m{m}/matrix/nonzero_percent": 3.0}
    put(tmp_path, "fmops", 32, metrics)
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    ours = [row for row in rows(table(tmp_path)) if "paper" not in row[0]]
    assert ours == [
        ["sampled by", "m=32", "m=8"],
        ["fps", "30.00", "4.00"],  # its own run replaces a baseline's values
        ["fmops", "32.00 / 32.00", "8.00 / 8.00"],
    ]
    put(tmp_path, "fmops", 8, {"test/generated/accuracy": 0.8})
    with pytest.raises(UserError, match=r"Two runs of fmops .*m=8 and seed=0"):
        table(tmp_path)


def test_cells_of_several_seeds_show_mean_and_deviation(tmp_path):
    for seed, value in enumerate((1.0, 2.0, 3.0)):
        put_cell(tmp_path, f"{seed}", "mops", {"generated": value, "matched": 1.5}, seed=seed)
    assert rows(table(tmp_path))[1] == ["mops", "2 ± 1.00 / 1.5 ± 0.00 (n=3)"]
    put_cell(tmp_path, "again", "mops", {"generated": 1.0}, seed=2)
    with pytest.raises(UserError, match=r"Two runs of mops .*m=32 and seed=2"):
        table(tmp_path)


def test_cells_two_runs_of_one_cell_are_refused(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        put(tmp_path / name, "fps", 32, {"test/sampled/accuracy": 0.3})
    with pytest.raises(UserError, match=r"Two runs of fps .*m=32"):
        table(tmp_path)


def test_cells_unknown_metric_is_refused(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    with pytest.raises(UserError, match=r"--metric: no run has 'acuracy'.*accuracy"):
        table(tmp_path, "acuracy")


def test_cells_refined_samples_have_row_of_their_own(tmp_path):
    metrics = {"test/full/accuracy": 0.9}
    for m in (8, 32):
        metrics |= {f"test/m{m}/{name}/accuracy": m / 100 for name in ("sampled", "refined")}
    put(tmp_path, "fps", 32, metrics)
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.3, "test/refined/accuracy": 0.7})
    ours = [row for row in rows(table(tmp_path)) if "paper" not in row[0]]
    assert ours[1:] == [
        ["fps", "32.00", "8.00"],
        ["fps refined (with the task net)", "32.00", "8.00"],
        ["mops", "30.00", ""],
        ["mops refined (with the task net)", "70.00", ""],
    ]
