import json

import pytest

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from tests.support.records import evaluated
from tests.support.reports import (
    put,
    put_cell,
    put_pairs,
    rows,
    table,
)


@pytest.mark.parametrize("name", ["dataset_fingerprint", "task_weights_sha256"])
def test_comparable_other_data_or_weights_are_refused(tmp_path, name):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.8}, **{name: "other"})
    with pytest.raises(UserError, match="differ in"):
        table(tmp_path)


def test_comparable_joint_runs_have_own_task_nets(tmp_path):
    for name in ("snet", "mops"):
        metrics = {"test/generated/accuracy": 0.5, "test/fps/accuracy": 0.2}
        joint = {"task_weights_sha256": name, "evaluated": evaluated(learn="joint")}
        put(tmp_path, name, 32, {**metrics, "test/full/accuracy": 0.9}, **joint)
    text = table(tmp_path)
    assert [row[0] for row in rows(text) if "paper" not in row[0]] == ["sampled by", "snet", "mops"]
    assert "pointnet on all points after joint training with snet, m=32: 90.00" in text
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    with pytest.raises(UserError, match=r"differ in what was trained"):
        table(tmp_path)


def test_comparable_other_pairs_are_refused(tmp_path):
    put_pairs(tmp_path, "fps", 32, 12.0)
    put_pairs(tmp_path, "mops", 32, 9.0, rotation=30)
    with pytest.raises(UserError, match=r"differ in pairs"):
        table(tmp_path)


def test_comparable_other_net_settings_are_refused(tmp_path):
    for name, passes in (("fps", 1), ("mops", 3)):
        put(
            tmp_path,
            name,
            32,
            {"test/sampled/accuracy": 0.5},
            settings={"net": {"iterations": passes}},
        )
    with pytest.raises(UserError, match=r"differ in settings of pointnet"):
        table(tmp_path)


def test_comparable_data_per_seed_need_every_sampler_per_seed(tmp_path):
    for seed in (0, 1):
        for name in ("mops", "fps"):
            values = {"generated": 1.0 + seed}
            path = put_cell(tmp_path, f"{name}{seed}", name, values, seed=seed)
            content = json.loads(path.read_text())
            content |= {
                "dataset_fingerprint": f"d{seed}",
                "task_weights_sha256": f"w{seed}",
            }
            path.write_text(json.dumps(content))
    assert rows(table(tmp_path))[1] == ["fps", "1.5 ± 0.71 (n=2)"]
    path.parent.joinpath(run_record.FILE).unlink()
    with pytest.raises(UserError, match="every sampler must have every seed"):
        table(tmp_path)
