"""Which runs share a table, and what its columns are."""

import re

import pytest

from mops_lightning.records import run_record
from mops_lightning.report.rows import net_labels
from tests.support.records import evaluated, record
from tests.support.reports import edited, put, put_cell, put_planes, rows, table

PCRNET = {"_target_": "mops_lightning.nets.pcrnet.PCRNet"}


def titles(text):
    return [line for line in text.splitlines() if line.startswith("Test ")]


def endings(text):
    """How the titles of tables say in what they differ from each other."""
    return [title.rpartition("(")[2] for title in titles(text)]


def labels(text):
    """The first cells of all rows, without those of the paper."""
    return [row[0] for row in rows(text) if "paper" not in row[0]]


@pytest.mark.parametrize("name", ["dataset_fingerprint", "task_weights_sha256"])
def test_other_data_or_weights_have_table_of_their_own(tmp_path, name):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.8}, **{name: "other"})

    text = table(tmp_path, mixed=True)

    first, second = titles(text)
    assert first.endswith(("(data d)", "(task weights w)"))
    assert second.endswith(("(data other)", "(task weights other)"))
    assert "2 groups of runs are not comparable" in text
    assert labels(text) == ["sampled by", "fps", "sampled by", "mops"]


def test_joint_runs_have_own_task_nets(tmp_path):
    metrics = {
        "test/generated/accuracy": 0.5,
        "test/fps/accuracy": 0.2,
        "test/full/accuracy": 0.9,
    }
    for name in ("snet", "mops"):
        joint = {"task_weights_sha256": name, "evaluated": evaluated(learn="joint")}
        put(tmp_path, name, 32, metrics, **joint)

    text = table(tmp_path)

    assert labels(text) == ["sampled by", "snet", "mops"]
    assert "pointnet on all points after joint training with snet, m=32: 90.00" in text

    several = {"test/m8/generated/accuracy": 0.4, "test/m32/generated/accuracy": 0.5}
    joint = {"task_weights_sha256": "fmops", "evaluated": evaluated(learn="joint")}
    put(tmp_path, "fmops", 32, {**several, "test/full/accuracy": 0.8}, **joint)

    text = table(tmp_path)

    assert "pointnet on all points after joint training with fmops: 80.00" in text

    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})

    joint_title, other = sorted(titles(table(tmp_path)))
    assert "learn=joint" in joint_title
    assert "learn=sampler alone" in other


@pytest.mark.parametrize(
    ("first", "second", "pattern", "found"),
    [
        ({"resample": None}, {"resample": 512}, r"resample=(\w+)", ["None", "512"]),
        (
            {"net": {"iterations": 1}},
            {"net": {"iterations": 3}},
            "iterations.: ([0-9])",
            ["1", "3"],
        ),
        # The default of an argument that one record sets.
        ({"net": PCRNET}, {"net": {**PCRNET, "iterations": 1}}, "net task.net", []),
        (
            {"net": {"sampler": {"start": None}}},
            {"net": {"sampler": {"start": "farthest"}}},
            r"start.: .?\b(\w+)",
            ["null", "farthest"],
        ),
        # The size and the seed of the run, which a sampler inside of the net does not use.
        (
            {"net": {"sampler": {"m": 32, "seed": 0}}},
            {"net": {"sampler": {"m": 8, "seed": 1}}},
            "net task.net",
            [],
        ),
    ],
)
def test_other_pairs_or_net_settings_have_table_of_their_own(
    tmp_path, first, second, pattern, found
):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.5}, settings=first)
    put(tmp_path, "mops", 32, {"test/sampled/accuracy": 0.5}, settings=second)

    text = "".join(titles(table(tmp_path)))

    assert re.findall(pattern, text) == found


def test_data_per_seed_need_every_sampler_per_seed(tmp_path):
    for seed in (0, 1):
        for name in ("mops", "fps"):
            values = {"generated": 1.0 + seed}
            path = put_cell(tmp_path, f"{name}{seed}", name, values, seed=seed)
            edited(path, dataset_fingerprint=f"d{seed}", task_weights_sha256=f"w{seed}")

    assert rows(table(tmp_path))[1][:2] == ["fps", "1.5 ± 0.71 (n=2)"]

    path.parent.joinpath(run_record.FILE).unlink()

    assert endings(table(tmp_path)) == ["data d0)", "data d1)"]


def test_other_commit_has_table_of_its_own_unless_mixed(tmp_path):
    path = put_cell(tmp_path, "a", "mops", {"generated": 1.0})
    put_cell(tmp_path, "b", "snet", {"generated": 2.0}, batch_size=7)  # may differ by sampler
    assert len(rows(table(tmp_path))) == 3

    edited(path, git={"commit": "f" * 40, "dirty": False})

    text = table(tmp_path)
    assert "commit ffffffffff)" in endings(text)
    assert "2 groups of runs are not comparable" in text
    assert "--mixed joins groups that differ in commit or settings only." in text
    assert len(rows(table(tmp_path, mixed=True))) == 3


def test_runs_of_two_lengths_and_sizes_have_tables_by_size(tmp_path):
    values = {"generated": 1.0}
    put_cell(tmp_path, "a", "mops", values, m=32, trainer={"max_epochs": 3})
    put_cell(tmp_path, "b", "mops", values, m=8, trainer={"max_epochs": 3})
    put_cell(tmp_path, "c", "mops", values, m=32, trainer={"max_epochs": 9})

    text = table(tmp_path)

    assert endings(text) == ["m 32)", "m 8)"]
    assert rows(text)[0] == ["sampled by", "trainer.max_epochs=3", "trainer.max_epochs=9"]
    assert rows(table(tmp_path, mixed=True))[0][:3] == ["sampled by", "m=32", "m=8"]


def test_runs_of_differing_settings_have_tables_of_their_own(tmp_path):
    put_cell(tmp_path, "fps", "fps", {"sampled": 3.0})
    for name in ("adam", "sgd"):
        put_cell(tmp_path, name, "mops", {"generated": 1.0}, optimizer={"name": name})

    text = table(tmp_path)

    assert endings(text) == ["optimizer.name=adam)", "optimizer.name=sgd)"]
    assert labels(text).count("fps") == 2, "comparable with both"
    assert len(titles(table(tmp_path, mixed=True))) == 1


def test_corruptions_give_columns_or_many_of_them_rows(tmp_path):
    for number, kind in enumerate((None, "shear-1", "shear-2")):
        values = {"generated": 1 + number, "full": 0.5}
        put_cell(tmp_path, f"a{number}", "mops", values, test_corruption=kind)
        put_cell(tmp_path, f"b{number}", "fps", {"sampled": 5.0}, test_corruption=kind)

    assert rows(table(tmp_path)) == [
        [
            "sampled by",
            "test_corruption=none",
            "test_corruption=shear-1",
            "test_corruption=shear-2",
        ],
        ["fps", "5", "5", "5"],
        ["mops", "1", "2", "3"],
        ["all points", "0.5", "0.5", "0.5"],
    ]

    for number in range(3, 9):
        values = {"generated": 1 + number}
        put_cell(tmp_path, f"a{number}", "mops", values, test_corruption=f"shear-{number}")

    down = rows(table(tmp_path))
    assert down[0] == ["test_corruption", "fps", "mops", "all points"]
    assert down[1] == ["none", "5", "1", "0.5"]
    assert down[-1] == ["shear-8", "", "9", ""]


@pytest.mark.parametrize("mixed", [False, True])
def test_setting_that_only_one_run_has_is_no_column(tmp_path, mixed):
    put_cell(tmp_path, "a", "mops", {"generated": 1.0}, optimizer={"weight_decay": 0.1})
    put_cell(tmp_path, "b", "mops", {"generated": 2.0}, optimizer={}, seed=1)

    text = table(tmp_path, mixed=mixed)

    if mixed:
        assert len(titles(text)) == 1
    else:
        assert len(titles(text)) == 2
        assert "(optimizer.weight_decay=0.1)" in text


def test_one_differing_setting_gives_columns(tmp_path):
    for noise in (0.0, 0.1, 0.02):
        values = {"generated": 1 + noise, "full": 0.5 + noise}
        put_cell(tmp_path, f"a{noise}", "mops", values, test_noise_std=noise)
        put_cell(tmp_path, f"b{noise}", "fps", {"sampled": 2 + noise}, test_noise_std=noise)
    expected = [
        ["sampled by", "test_noise_std=0.0", "test_noise_std=0.02", "test_noise_std=0.1"],
        ["fps", "2", "2.02", "2.1"],
        ["mops", "1", "1.02", "1.1"],
        ["all points", "0.5", "0.52", "0.6"],
    ]
    assert rows(table(tmp_path)) == expected

    for noise in (0.0, 0.1):
        name = f"c{noise}"
        put_cell(tmp_path, name, "mops", {"generated": 1.5}, test_noise_std=noise, m=8)

    text = table(tmp_path)
    assert endings(text) == ["m 32)", "m 8)"]
    assert rows(text)[:4] == expected
    assert ["mops", "1.5", "1.5"] in rows(text)


def test_two_differing_settings_give_plane_per_sampler(tmp_path):
    put_planes(tmp_path)

    text = table(tmp_path)

    assert "Test nre cd of samplenet" in text
    assert rows(text) == [
        ["beta \\ gamma", "1e-05", "0.001", "0.1"],
        ["0.1", "0.1 / 3", "0.101 / 3", "0.2 / 3"],
        ["1", "1 / 3", "1.001 / 3", "1.1 / 3"],
        ["alpha \\ tau", "0.5", "0.9"],
        ["0.1", "1 / 2", "1 / 2"],
        ["1", "1.5 / 2", "1.9 / 2"],
    ]
    assert "of mops: reconstruction on shapes, m=32, under autoencoder" in text
    assert "plane of mops: generated 1 to 1.9 (factor 1.9), matched 2 to 2 (factor 1)." in text


def test_planes_of_several_sizes_have_tables_of_their_own(tmp_path):
    put_planes(tmp_path)
    put_cell(tmp_path, "other", "mops", {"generated": 1.0}, m=8, of={"alpha": 0.1, "tau": 0.7})

    assert set(endings(table(tmp_path))) == {"m 32)", "m 8)"}


def test_same_samples_under_several_nets_have_column_per_net(tmp_path):
    for digest, net, weights, value in (
        ("w", "pointnet", "run", 0.8),
        ("a", "pointnet", "outputs/pointnet-1", 0.6),
        ("b", "dgcnn", "x", 0.4),
    ):
        metrics = {
            "test/m8/generated/accuracy": value - 0.08,
            "test/m32/generated/accuracy": value - 0.32,
            "test/m8/fps/accuracy": 0.1,
            "test/full/accuracy": 0.9,
        }
        changes = {"evaluated": evaluated(), "task_weights_sha256": digest}
        config = {"weights": weights}
        put(tmp_path / digest, "fmops", 32, metrics, net=net, config=config, **changes)

    assert rows(table(tmp_path)) == [
        ["m", "sampled by", "pointnet of the training", "dgcnn (x)", "pointnet-1"],
        ["32", "fmops", "48.00", "8.00", "28.00"],
        ["8", "fps", "10.00", "10.00", "10.00"],
        ["8", "fmops", "72.00", "32.00", "52.00"],
        ["", "all points", "90.00", "90.00", "90.00"],
    ]


def test_nets_of_one_name_are_told_apart_by_their_weights():
    first = record(task_weights_sha256="a" * 64)
    second = record(task_weights_sha256="b" * 64)

    assert net_labels([first, second]) == ["pointnet aaaaaaaa", "pointnet bbbbbbbb"]
    assert net_labels([first, first]) == ["pointnet", "pointnet"]


@pytest.mark.parametrize("columns", [3, 8, 9, 12])
def test_any_number_of_noise_levels_gives_a_table_of_all(tmp_path, columns):
    levels = [round(0.01 * number, 2) for number in range(columns)]
    for level in levels:
        metrics = {"test/generated/accuracy": 0.9 - level, "test/full/accuracy": 0.95 - level}
        put(tmp_path / f"{level}", "mops", 32, metrics, config={"test_noise_std": level})

    found = rows(table(tmp_path))

    if columns <= 8:
        found = [list(column) for column in zip(*found, strict=True)]
    head, *lines = found
    shown = [line[0].removeprefix("test_noise_std=") for line in lines]
    assert head[1:] == ["mops", "all points"]
    assert [float(text) for text in shown] == levels
    last = 100 * levels[-1]
    assert lines[-1][1:] == [f"{90 - last:.2f}", f"{95 - last:.2f}"]
