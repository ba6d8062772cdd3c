"""Settings of earlier versions."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.records import run_record
from mops_lightning.records.migrate import OLD, answer, upgraded_config, upgraded_overrides
from tests.support.command_line import call

RESULTS = Path(__file__).parents[2] / "results"
SAMPLERS = ("mops", "fmops", "snet", "samplenet", "snet_progressive", "samplenet_progressive")


def known_keys():
    """Every dotted key, and every node, of all samplers' configurations."""
    found = set()
    for sampler in SAMPLERS:
        cfg = compose([f"sampler={sampler}", "optimizer=exponential"])
        for key in run_record.dotted(OmegaConf.to_container(cfg, resolve=True)):
            found |= {key, *(key[:i] for i, letter in enumerate(key) if letter == ".")}
    return found


def test_new_keys_exist_and_old_ones_do_not():
    known = known_keys()
    assert {now.key for now in OLD.values() if now.key} <= known
    assert not known & set(OLD)


@pytest.mark.parametrize("key", OLD)
def test_old_key_answer_names_the_new_one(key):
    now = OLD[key]
    assert (now.key or now.hint) in str(answer(key))
    assert (f"{now.key}.below" if now.key else now.hint) in str(answer(f"{key}.below"))


@pytest.mark.parametrize("key", ["m", "sampler.alpha", "noises", "optimizer.lr", "labels_x"])
def test_present_or_unknown_key_has_no_answer(key):
    assert answer(key) is None


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("task_rate=0.1", "task_rate is now called task_lr_scale"),
        ("+noise=0.1", "noise is now called test_noise_std"),
        ("++optimizer.optimizer.lr=1", "optimizer.optimizer.lr is now called optimizer.lr"),
        ("~labels", "labels is no longer a setting: use hydra.run.dir"),
        ("~epochs.joint=6", "epochs.joint is now called epochs.sampler"),
        ("paper.alpha=3,10", "paper.alpha is now called sampler.alpha"),
    ],
)
def test_old_key_on_the_command_line_is_refused(argument, said, tmp_path):
    status, _, err = call([argument], tmp_path)
    assert status == 2
    assert said in err
    assert len(err.strip().splitlines()) == 1


def test_upgraded_overrides_rename_and_drop():
    old = ["m=8", "++optimizer.optimizer.lr=1e-3", "labels.task=x", "noise=0,0.1", "~epochs.joint"]
    new = ["m=8", "++optimizer.lr=1e-3", "test_noise_std=0,0.1", "~epochs.sampler"]
    assert upgraded_overrides(old) == new
    assert upgraded_overrides(new) == new


OLD_CONFIG = {
    "m": 8,
    "seed": 1,
    "learn": "joint",
    "noise": 0.1,
    "paper": {"alpha": 30.0},
    "epochs": {"task": 12, "sampler": 6, "joint": 3, "nothing": 0},
    "augment": {"sampler": {"jitter": 0.0}, "joint": {"jitter": 0.1}},
    "sampler": {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "prefixes": 4},
    "baselines": {"fps": {"m": 8, "seed": 1, "start": None}, "voxel": None},
    "optimizer": {
        "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True, "lr": 0.001},
        "schedule": {"_target_": "mops_lightning.schedules.one_cycle", "_partial_": True},
    },
}
NEW_CONFIG = {
    "m": 8,
    "seed": 1,
    "learn": "joint",
    "test_noise_std": 0.1,
    "epochs": {"task": 12, "sampler": 3},
    "augment": {"sampler": {"jitter": 0.1}},
    "sampler": {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "num_sizes": 4},
    "baselines": {"fps": {}, "voxel": None},
    "optimizer": {
        "_target_": "torch.optim.Adam",
        "lr": 0.001,
        "schedule": {"_target_": "mops_lightning.training.schedules.one_cycle"},
    },
}


def test_upgraded_config_is_idempotent():
    assert upgraded_config(OLD_CONFIG) == NEW_CONFIG
    assert upgraded_config(NEW_CONFIG) == NEW_CONFIG
    assert OLD_CONFIG["epochs"] == {"task": 12, "sampler": 6, "joint": 3, "nothing": 0}


def test_read_committed_records_get_present_names():
    paths = sorted(RESULTS.rglob(run_record.FILE))
    assert paths
    for path in paths:
        record = run_record.read(path.parent)
        keys = run_record.dotted(record["config"])
        assert [key for key in keys if answer(key)] == [], path
        assert upgraded_overrides(record["overrides"]) == record["overrides"], path
