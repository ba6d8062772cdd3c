import shutil

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.report.collect import sampler_row
from mops_lightning.report.long_form import long_form
from mops_lightning.report.rows import RowNames, sort_key
from mops_lightning.report.tables import over_seeds
from tests.support.records import NAMES, evaluated, record
from tests.support.reports import edited, put, put_cell, rows, table


def our_rows(text):
    """The cells of all rows but those of the paper."""
    return [row for row in rows(text) if "paper" not in row[0]]


def test_cells_run_of_many_sizes_fills_columns(tmp_path):
    metrics = {"test/full/accuracy": 0.9}
    for m in (8, 32):
        metrics[f"test/m{m}/generated/accuracy"] = m / 100
        metrics[f"test/m{m}/matched/accuracy"] = m / 100
        metrics[f"test/m{m}/fps/accuracy"] = m / 200
        metrics[f"test/m{m}/matrix/nonzero_percent"] = 3.0
    put(tmp_path, "fmops", 32, metrics)
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})

    assert our_rows(table(tmp_path)) == [
        ["sampled by", "m=32", "m=8"],
        ["fps", "30.00", "4.00"],  # its own run replaces a baseline's values
        ["fmops", "32.00 / 32.00", "8.00 / 8.00"],
    ]

    put(tmp_path, "fmops", 8, {"test/generated/accuracy": 0.8})

    text = table(tmp_path)
    assert ["fmops", "32.00 / 32.00", "80.00"] in rows(text)
    assert "fmops-32-pointnet: not shown; a later run has the same row" in text


def test_cells_of_several_seeds_show_mean_and_deviation(tmp_path):
    for seed, value in enumerate((1.0, 2.0, 3.0)):
        values = {"generated": value, "matched": 1.5}
        put_cell(tmp_path, f"{seed}", "mops", values, seed=seed)

    assert rows(table(tmp_path))[1][:2] == ["mops", "2 ± 1.00 / 1.5 ± 0.00 (n=3)"]


def test_deviation_has_as_many_decimals_as_the_mean_and_at_least_two():
    metric = MetricInfo("error", higher_is_better=False)

    assert over_seeds(metric, 0.01234, 0.00123) == "0.01234 ± 0.00123"
    assert over_seeds(metric, 12.0, 1.5) == "12 ± 1.50"
    assert over_seeds(metric, 12.0, float("nan")) == "12"


def test_evaluations_count_by_the_seeds_of_their_runs(tmp_path):
    for seed in (0, 1):
        metrics = {"test/generated/accuracy": 0.5 + seed / 10}
        put(tmp_path / f"{seed}", "mops", 32, metrics, evaluated=evaluated(seed=seed))

    assert rows(table(tmp_path))[1][1] == "55.00 ± 7.07 (n=2)"


def test_long_form_has_the_epochs_of_the_training():
    trained = record(folder="a", seconds={"fit": 1.0, "total": 1.0})
    untrained = record(folder="b")
    again = record(folder="c", evaluated=evaluated(max_epochs=9))
    found = [trained, untrained, again]

    long = long_form(found, RowNames(found, "pointnet"))

    assert long.epochs.tolist() == [3, 0, 9]


def test_later_of_two_equal_runs_counts(tmp_path):
    first = "2026-01-01T02:00:00+00:00"
    second = "2026-01-01T03:00:00+00:00"
    put(tmp_path / "b", "fps", 32, {"test/sampled/accuracy": 0.3}, started=first)
    put(tmp_path / "a", "fps", 32, {"test/sampled/accuracy": 0.4}, started=second)

    text = table(tmp_path)
    assert ["fps", "40.00"] in rows(text)
    assert f"- {tmp_path}/b/fps-32-pointnet: not shown" in text


def test_own_run_counts_though_a_baseline_is_later(tmp_path):
    first = "2026-01-01T02:00:00+00:00"
    second = "2026-01-01T03:00:00+00:00"
    scores = {"test/generated/accuracy": 0.5, "test/fps/accuracy": 0.2}
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3}, started=first)
    put(tmp_path, "mops", 32, scores, started=second)

    assert our_rows(table(tmp_path))[1:] == [["fps", "30.00"], ["mops", "50.00"]]


def test_row_of_a_sampler_trained_under_several_nets_has_their_number():
    assert sampler_row(record(config={"other_nets": {"dgcnn": {}}})) == "mops 2 nets"


def test_best_is_bold_and_second_underlined(tmp_path):
    accuracies = {"mops": 0.8, "snet": 0.7, "samplenet": 0.8, "gumbel": 0.6}
    for name, value in accuracies.items():
        metrics = {"test/generated/accuracy": value, "test/completed/accuracy": 0.5}
        put(tmp_path, name, 32, metrics)
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.9})

    text = table(tmp_path)

    lines = {}
    for line in text.splitlines():
        if ".00" in line:
            name, _, cells = line.strip("| ").partition(" | ")
            lines[name] = cells
    assert lines["fps"] == "**90.00**"  # competes with completed sets
    assert lines["mops"] == lines["samplenet"] == "**80.00** / <u>50.00</u>"
    assert lines["snet"] == "<u>70.00</u> / <u>50.00</u>"
    assert lines["gumbel"] == "60.00 / <u>50.00</u>"


def test_training_is_summed_over_sizes_for_one_seed(tmp_path):
    for m, seed in ((8, 0), (32, 0), (8, 1), (32, 1), (64, 0)):
        name = f"m{m}-seed{seed}"
        put_cell(tmp_path, name, "mops", {"generated": 1.0}, m=m, seed=seed, cost=1000.0)
    put_cell(tmp_path, "snet", "snet", {"generated": 2.0}, cost=700.4)

    costs = [row[-1] for row in rows(table(tmp_path))]

    assert costs == ["training (wall)", "700 s", "3,000 s"]


def test_training_is_cpu_time_if_every_run_has_it(tmp_path):
    for name, seconds in (("mops", 300.0), ("snet", 500.0)):
        path = put_cell(tmp_path, name, name, {"generated": 1.0})
        edited(path, seconds={"total": 99.0, "fit": 90.0, "fit_cpu": seconds})

    costs = [row[-1] for row in rows(table(tmp_path))]

    assert costs == ["training (CPU)", "500 s", "300 s"]


def test_training_is_wall_time_if_one_run_has_no_cpu_time(tmp_path):
    path = put_cell(tmp_path, "mops", "mops", {"generated": 1.0})
    edited(path, seconds={"total": 99.0, "fit": 90.0, "fit_cpu": 300.0})
    path = put_cell(tmp_path, "snet", "snet", {"generated": 1.0})
    edited(path, seconds={"total": 99.0, "fit": 80.0})
    found = rows(table(tmp_path))
    assert [row[-1] for row in found] == ["training (wall)", "80 s", "90 s"]


def test_values_within_two_deviations_of_the_best_are_level(tmp_path):
    """The deviations of the best and of the value are 0.1; 0.15 away is level, 0.5 is not."""
    means = {"mops": 1.0, "fmops": 1.15, "snet": 1.5, "samplenet": 1.6}
    for name, mean in means.items():
        for seed, shift in enumerate((-0.1, 0.0, 0.1)):
            values = {"generated": mean + shift}
            put_cell(tmp_path, f"{name}{seed}", name, values, seed=seed)

    text = table(tmp_path)

    assert "**1 ± 0.10**" in text
    assert "**1.15 ± 0.10**" in text
    assert "<u>1.5 ± 0.10</u>" in text
    assert "| 1.6 ± 0.10" in text
    assert "those level with it: less than two standard deviations over seeds away, or" in text

    for path in tmp_path.glob("*[12]"):
        shutil.rmtree(path)

    text = table(tmp_path)
    assert "**0.9**" in text
    assert "<u>1.05</u>" in text
    assert "level" not in text


def test_percentages_within_two_deviations_of_the_best_are_level(tmp_path):
    """The best has a deviation of 2 %: 3 % less is level, 5 % less is not."""
    for seed, value in enumerate((0.78, 0.80, 0.82)):
        put(tmp_path / f"{seed}", "mops", 32, {"test/generated/accuracy": value}, seed=seed)
    put(tmp_path, "fmops", 32, {"test/generated/accuracy": 0.77})
    put(tmp_path, "snet", 32, {"test/generated/accuracy": 0.75})

    text = table(tmp_path)

    assert "| mops | **80.00 ± 2.00** (n=3)" in text
    assert "| fmops | **77.00** |" in text
    assert "| snet | <u>75.00</u> |" in text


def test_equal_cells_are_named(tmp_path):
    for alpha in (1, 10, 100):
        values = {"generated": 1.037, "matched": 1.035}
        put_cell(tmp_path, f"a{alpha}", "mops", values, of={"alpha": alpha})
        values = {"generated": float(alpha)}
        put_cell(tmp_path, f"b{alpha}", "snet", values, of={"alpha": alpha})

    text = table(tmp_path)

    assert "All 3 cells of mops are equal: the settings that differ changed no figure." in text
    assert "cells of snet" not in text


def test_values_within_two_deviations_of_a_spread_best_are_level(tmp_path):
    """The best has a deviation of 0.1, the second of one seed has none: 0.15 away is level."""
    for seed, value in enumerate((0.9, 1.0, 1.1)):
        put_cell(tmp_path, f"mops{seed}", "mops", {"generated": value}, seed=seed)
    put_cell(tmp_path, "fmops", "fmops", {"generated": 1.15})
    put_cell(tmp_path, "snet", "snet", {"generated": 1.25})

    text = table(tmp_path)

    assert "| mops | **1 ± 0.10** (n=3)" in text
    assert "| fmops | **1.15** |" in text
    assert "| snet | <u>1.25</u> |" in text
    assert "those level with it" in text


def test_value_with_a_spread_of_its_own_is_level_with_a_best_of_one_seed(tmp_path):
    put_cell(tmp_path, "mops", "mops", {"generated": 1.0})
    for seed, value in enumerate((1.05, 1.15, 1.25)):
        put_cell(tmp_path, f"fmops{seed}", "fmops", {"generated": value}, seed=seed)

    text = table(tmp_path)

    assert "| mops | **1** |" in text
    assert "| fmops | **1.15 ± 0.10** (n=3)" in text


def test_value_is_level_with_the_best_where_a_worse_one_is(tmp_path):
    """The third reaches the best by its own deviation, the second does not, but is better."""
    for seed, value in enumerate((0.99, 1.0, 1.01)):
        put_cell(tmp_path, f"mops{seed}", "mops", {"generated": value}, seed=seed)
        put_cell(tmp_path, f"snet{seed}", "snet", {"generated": value + 0.1}, seed=seed)
        put_cell(tmp_path, f"fmops{seed}", "fmops", {"generated": 12 * value - 10.8}, seed=seed)
    put_cell(tmp_path, "samplenet", "samplenet", {"generated": 1.3})

    text = table(tmp_path)

    assert "| mops | **1 ± 0.01** (n=3)" in text
    assert "| snet | **1.1 ± 0.01** (n=3)" in text
    assert "| fmops | **1.2 ± 0.12** (n=3)" in text
    assert "| samplenet | <u>1.3</u> |" in text


def test_nets_for_different_largest_sizes_have_rows_of_their_own(tmp_path):
    for largest, value in ((128, 0.8), (512, 0.7)):
        metrics = {"test/m8/generated/accuracy": value, "test/m32/generated/accuracy": value}
        of = {"m_max": largest, "alpha": 1}
        put(tmp_path / f"{largest}", "fmops", 32, metrics, of=of, config={"weights": "auto"})
    put(tmp_path / "other size", "mops", 32, {"test/generated/accuracy": 0.9}, of={"m": 32})
    put(tmp_path / "other size", "mops", 8, {"test/generated/accuracy": 0.5}, of={"m": 8})

    assert our_rows(table(tmp_path)) == [
        ["sampled by", "m=32", "m=8"],
        ["mops", "90.00", "50.00"],
        ["fmops m_max=128", "80.00", "80.00"],
        ["fmops m_max=512", "70.00", "70.00"],
    ]


def test_mixed_table_keeps_samplers_apart_that_would_share_a_cell(tmp_path):
    """One row has another alpha for another size, which is a choice; the other has two for one."""
    for name, sampler, m, alpha in (
        ("a", "mops", 8, 1.0),
        ("b", "mops", 32, 10.0),
        ("c", "snet", 8, 1.0),
        ("d", "snet", 8, 10.0),
    ):
        metrics = {"test/generated/accuracy": alpha / 20}
        put(tmp_path / name, sampler, m, metrics, of={"alpha": alpha, "m": m})

    assert our_rows(table(tmp_path, mixed=True))[1:] == [
        ["snet alpha=1", "", "5.00"],
        ["snet alpha=10", "", "50.00"],
        ["mops", "50.00", "5.00"],
    ]


def test_mixed_table_shows_trials_of_one_seed_with_the_settings_they_differ_in(tmp_path):
    for name, m, lr, seed in (
        ("a", 8, 1e-2, 0),
        ("b", 8, 2e-2, 0),
        ("c", 32, 2e-2, 0),
        ("d", 32, 2e-2, 1),
    ):
        metrics = {"test/generated/accuracy": 10 * lr + seed / 100}
        config = {"optimizer": {"lr": lr}}
        put(tmp_path / name, "snet", m, metrics, of={"m": m}, seed=seed, config=config)

    text = table(tmp_path, mixed=True)

    assert our_rows(text)[1:] == [
        ["snet lr=0.01", "", "10.00"],
        ["snet lr=0.02", "20.50 ± 0.71 (n=2)", "20.00"],
    ]
    assert "not shown" not in text


def test_trials_are_named_by_the_optimizer_and_by_what_all_of_them_have(tmp_path):
    adam = {"_target_": "torch.optim.Adam", "lr": 0.01}
    muon = {"_target_": "mops_lightning.training.muon.MuonAdam", "lr": 0.01, "momentum": 0.95}
    for name, m, optimizer in (("a", 8, adam), ("b", 8, muon), ("c", 32, muon)):
        metrics = {"test/generated/accuracy": 0.5}
        put(tmp_path / name, "snet", m, metrics, of={"m": m}, config={"optimizer": optimizer})

    assert our_rows(table(tmp_path, mixed=True))[1:] == [
        ["snet Adam", "", "50.00"],
        ["snet MuonAdam", "50.00", "50.00"],
    ]


def test_a_test_of_a_run_has_no_rate_of_its_own(tmp_path):
    """Its record has the optimizer's defaults: ``evaluate=RUN`` does not take RUN's optimizer."""
    metrics = {"test/generated/accuracy": 0.5}
    for name, lr, rest in (("a", 0.02, {}), ("b", 0.01, {"evaluated": evaluated()})):
        config = {"optimizer": {"lr": lr}}
        put(tmp_path / name, "snet", 8, metrics, of={"m": 8}, config=config, **rest)
    put(tmp_path / "c", "snet", 32, metrics, of={"m": 32}, config={"optimizer": {"lr": 0.02}})

    for mixed in (True, False):
        text = table(tmp_path, mixed=mixed)
        assert "lr=" not in text


def test_a_test_beside_trials_of_two_rates_is_named_without_a_rate(tmp_path):
    metrics = {"test/generated/accuracy": 0.5}
    for name, m, lr in (("a", 8, 0.02), ("b", 8, 0.04), ("c", 32, 0.04)):
        put(tmp_path / name, "snet", m, metrics, of={"m": m}, config={"optimizer": {"lr": lr}})
    of_test = {"config": {"optimizer": {"lr": 0.01}}, "evaluated": evaluated(max_epochs=None)}
    put(tmp_path / "d", "snet", 8, metrics, of={"m": 8}, **of_test)

    names = [row[0] for row in our_rows(table(tmp_path, mixed=True))[1:]]

    assert names == ["snet", "snet lr=0.02", "snet lr=0.04"]


def test_numbers_in_names_of_rows_are_sorted_by_their_values():
    names = ["mops epochs=110", "mops epochs=60", "mops lr=0.02", "mops lr=1e-05", "fps"]

    assert sorted(names, key=sort_key) == [
        "fps",
        "mops epochs=60",
        "mops epochs=110",
        "mops lr=1e-05",
        "mops lr=0.02",
    ]


def test_seeds_with_other_settings_stay_one_row_of_a_mixed_table(tmp_path):
    for name, m, lr, seed in (("a", 8, 1e-2, 0), ("b", 8, 2e-2, 1), ("c", 32, 2e-2, 0)):
        metrics = {"test/generated/accuracy": 10 * lr}
        config = {"optimizer": {"lr": lr}}
        put(tmp_path / name, "snet", m, metrics, of={"m": m}, seed=seed, config=config)

    assert our_rows(table(tmp_path, mixed=True))[1:] == [["snet", "20.00", "15.00 ± 7.07 (n=2)"]]


def test_a_whole_number_written_in_two_ways_gives_one_row(tmp_path):
    """The defaults have alpha=30.0, and ``sampler.alpha=30`` on the command line an integer."""
    for name, m, alpha in (("a", 8, 3), ("b", 8, 30.0), ("c", 32, 30)):
        values = {"test/generated/accuracy": 0.5}
        put(tmp_path / name, "mops", m, values, of={"alpha": alpha, "m": m})

    assert our_rows(table(tmp_path, mixed=True))[1:] == [
        ["mops alpha=3", "", "50.00"],
        ["mops alpha=30", "50.00", "50.00"],
    ]


def test_cell_with_a_run_of_a_changed_checkout_is_marked(tmp_path):
    for name, sampler, is_dirty in (("a", "mops", True), ("b", "fps", False)):
        metrics = {"test/sampled/accuracy": 0.5}
        put(tmp_path / name, sampler, 8, metrics, git={"commit": "c" * 40, "dirty": is_dirty})

    text = table(tmp_path)

    assert ["mops", "50.00 †"] in rows(text)
    assert ["fps", "50.00"] in rows(text)
    assert "† With a run whose checkout had changes that no commit has." in text


OWN = {"names": {**NAMES, "dataset": "modelnet40", "sampler": "own"}}


def test_own_samplers_have_rows_named_by_their_classes(tmp_path):
    for name, target, value in (("a", "mine.Corners", 0.5), ("b", "mine.Edges", 0.6)):
        metrics = {"test/sampled/accuracy": value}
        put(tmp_path / name, "own", 8, metrics, of={"_target_": target}, config=OWN)

    found = rows(table(tmp_path, mixed=True))

    assert found[1:] == [["Corners", "50.00"], ["Edges", "60.00"]]


def test_own_task_and_net_are_named_in_titles(tmp_path):
    names = {**NAMES, "task": "own", "net": "own", "dataset": "own"}
    settings = {"_target_": "mine.Counting", "net": {"_target_": "mine.Counter"}}
    config = {"names": names, "dataset": {"_target_": "mine.boxes"}}
    put(tmp_path, "fps", 8, {"test/sampled/accuracy": 0.5}, settings=settings, config=config)

    assert "Test accuracy (%): Counting on boxes under Counter;" in table(tmp_path)


def test_projected_points_are_a_fourth_figure_and_compete_with_generated_ones(tmp_path):
    samplenet = {
        "test/generated/accuracy": 0.6,
        "test/matched/accuracy": 0.7,
        "test/completed/accuracy": 0.7,
        "test/projected/accuracy": 0.9,
    }
    put(tmp_path, "samplenet", 32, samplenet)
    mops = {
        "test/generated/accuracy": 0.8,
        "test/matched/accuracy": 0.5,
        "test/completed/accuracy": 0.5,
    }
    put(tmp_path, "mops", 32, mops)

    text = table(tmp_path)

    assert "60.00 / **70.00** / **70.00** / **90.00**" in text
    assert "<u>80.00</u> / <u>50.00</u> / <u>50.00</u>" in text
    assert "generated / matched / completed (SampleNet: / projected) sets" in text


def test_own_samplers_in_one_table_are_told_apart_by_class_setting_and_module(tmp_path):
    samplers = [
        {"_target_": "lab.Kmeans", "rounds": 1},
        {"_target_": "lab.Kmeans", "rounds": 9},
        {"_target_": "lab.Median"},
        {"_target_": "old_lab.Median"},
    ]
    for place, sampler in enumerate(samplers):
        values = {"test/sampled/accuracy": 0.1 * (place + 1)}
        put(tmp_path / f"{place}", "own", 32, values, of=sampler)

    text = table(tmp_path, mixed=True)

    assert rows(text)[1:] == [
        ["Kmeans rounds=1", "10.00"],
        ["Kmeans rounds=9", "20.00"],
        ["Median lab.Median", "30.00"],
        ["Median old_lab.Median", "40.00"],
    ]
    assert "not shown" not in text


PAPERS_ORDER = [
    "random",
    "serial",
    "voxel",
    "fps",
    "poisson",
    "normal_space",
    "covariance",
    "information",
    "steady",
    "pose",
    "critical",
    "submodular",
    "gumbel",
    "snet",
    "samplenet",
    "samplenet_progressive",
    "mops",
    "mops fast",
    "fmops",
    "apes",
    "dgcnn on random",
]


def test_rows_are_in_the_papers_order_then_others_then_those_of_other_nets():
    shuffled = PAPERS_ORDER[::-1]

    shuffled.sort(key=sort_key)

    assert shuffled == PAPERS_ORDER


def test_plane_has_only_the_columns_of_its_sampler_and_no_factor_from_zero(tmp_path):
    for sampler, taus in (("mops", (0.5, 0.9)), ("snet", (0.5, 0.7))):
        for alpha, tau in ((1, taus[0]), (2, taus[1])):
            values = {"generated": alpha - 1.0}
            of = {"alpha": alpha, "tau": tau}
            put_cell(tmp_path, f"{sampler}{alpha}", sampler, values, of=of)

    text = table(tmp_path)

    assert rows(text) == [
        ["alpha \\ tau", "0.5", "0.7"],
        ["1", "0", ""],
        ["2", "", "1"],
        ["alpha \\ tau", "0.5", "0.9"],
        ["1", "0", ""],
        ["2", "", "1"],
    ]
    assert "Spread over the plane of mops: generated 0 to 1." in text


def test_costs_of_a_sampler_of_many_sizes_are_of_its_largest_one(tmp_path):
    """Two trainings for the same largest size, tested at two sizes, cost as much as one."""
    for m in (8, 32):
        put_cell(tmp_path, f"{m}", "fmops", {"generated": 1.0}, m=m, cost=100.0, of={"m_max": 64})

    assert rows(table(tmp_path))[1][-1] == "100 s"


def test_deviation_of_numbers_with_an_exponent_has_two_decimals():
    metric = MetricInfo("error", higher_is_better=False)

    assert over_seeds(metric, 1.25e-7, 0.5) == "1.25e-07 ± 0.50"
