"""The groups of conf/: what one run's configuration shows, and what depends on several groups."""

from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose, conf_dir
from mops_lightning.config.settings import declared
from mops_lightning.config.validate import check
from mops_lightning.records.run_record import dotted, read
from tests.support.command_line import TINY, TINY_ANY_DATA, call, runs

TASKS = ("classification", "registration", "reconstruction")


@pytest.mark.parametrize(
    "chosen", [[], ["task=reconstruction", "sampler=fmops"], ["task=registration", "sampler=fmops"]]
)
def test_run_is_described_in_120_lines(chosen, tmp_path):
    status, out, err = call([*chosen, "--cfg", "job", "m=64"], tmp_path)
    assert (status, err) == (0, "")
    assert "m: 64" in out.splitlines()
    assert len(out.splitlines()) <= 120


def test_help_shows_every_key_and_choice(tmp_path):
    _, out, _ = call(["--help"], tmp_path)
    for name, setting in declared().items():
        text = " ".join(out.split())
        assert setting.group or f"{name} {setting.help}" in text
    for group in ("sampler", "task/net", "dataset", "recipe", "experiment"):
        names = sorted(path.stem for path in conf_dir().joinpath(group).glob("*.yaml"))
        assert f"\n{group}: {', '.join(names)}\n" in out
    assert out.index("report ") < out.index("downsample ") < out.index("sampler:")
    hidden = ("sampler/", "dataset_task", "task_settings")
    assert not any(line.startswith(hidden) for line in out.splitlines())


def test_no_default_is_computed_from_other_choices():
    for path in conf_dir().rglob("*.yaml"):
        text = path.read_text()
        assert not any(word in text for word in ("choose:", "model_for:", "oc.select")), path


def test_only_experiments_set_keys_of_other_groups():
    names = [
        path.relative_to(conf_dir()).as_posix()
        for path in conf_dir().rglob("*.yaml")
        if "@package _global_" in path.read_text()
    ]
    assert names
    assert {name.split("/")[0] for name in names} == {"experiment"}


def test_specialised_files_belong_to_groups_that_exist():
    root = conf_dir()
    for path in root.glob("dataset_task/*.yaml"):
        dataset, task = path.stem.rsplit("_", 1)
        assert (root / "dataset" / f"{dataset}.yaml").is_file()
        assert task in TASKS
    for path in [
        *root.glob("task_settings/*"),
        *root.glob("sampler/*/*"),
        *root.glob("optimizer/*/*"),
    ]:
        group, _, choice = path.stem.partition("_")
        group = "recipe" if group in TASKS and choice else group
        assert path.stem in TASKS or (root / group / f"{choice}.yaml").is_file()


@pytest.mark.parametrize(
    ("task", "alpha", "tau_min"),
    [("classification", 30.0, 0.1), ("registration", 1.0, 0.1), ("reconstruction", 0.2, 0.5)],
)
def test_mops_alpha_and_tau_depend_on_task(task, alpha, tau_min):
    for sampler in ("mops", "fmops"):
        node = compose([f"task={task}", f"sampler={sampler}"]).sampler
        assert (node.alpha, node.tau_min) == (alpha, tau_min)


@pytest.mark.parametrize(
    ("task", "learn", "rate"),
    [
        ("classification", "sampler", 1e-2),
        ("classification", "joint", 1e-2),
        ("registration", "sampler", 1e-3),
        ("reconstruction", "sampler", 5e-4),
    ],
)
def test_snet_rate_depends_on_task(task, learn, rate):
    cfg = compose([f"task={task}", f"learn={learn}", "sampler=snet"])
    own = 5e-4 if task == "registration" else 1e-3  # it starts from given weights
    assert (cfg.optimizer.lr, cfg.pretrain.lr) == (rate, own)


@pytest.mark.parametrize(
    ("overrides", "epochs"),
    [
        ([], (12, 10)),
        (["task=registration"], (30, 15)),
        (["dataset=modelnet40"], (30, 8)),
        (["dataset=modelnet40", "task=reconstruction"], (200, 60)),
        (["dataset=shapenet_core", "task=reconstruction"], (100, 30)),
        (["dataset=clouds", "dataset.root=x", "task=reconstruction"], (100, 30)),
        (["experiment=reconstruction_paper"], (400, 250)),
        (["experiment=own_scans", "dataset.root=x"], (60, 30)),
    ],
)
def test_epochs_depend_on_dataset_and_task(overrides, epochs):
    cfg = compose(overrides)
    assert (cfg.epochs.task, cfg.epochs.sampler) == epochs
    lengths = {}
    for cfg.learn in LEARN:  # Hydra chooses no group by it
        lengths[cfg.learn] = cfg.trainer.max_epochs
    assert lengths == {"task": epochs[0], "sampler": epochs[1], "joint": epochs[1], "nothing": 0}


@pytest.mark.parametrize("sampler", ["mops", "fmops", "samplenet", "fps"])
def test_spelling_of_weights_changes_nothing_else(sampler):
    chosen = ["task=registration", f"sampler={sampler}"]
    spellings = ["auto", "pcrnet.modelnet40", "models/pcrnet.modelnet40.safetensors", "null"]
    found: list[Any] = [compose([*chosen, f"weights={name}"]) for name in spellings]
    for cfg in found:
        cfg.weights = "the same"
    assert all(cfg == found[0] for cfg in found)
    started: list[Any] = [
        compose([*chosen, f"recipe.warm_start={name}"])
        for name in ("true", "fmops.pairs-m64", "models/fmops.pairs-m64.safetensors")
    ]
    for cfg in started:
        cfg.recipe.warm_start = True
    assert all(cfg == started[0] for cfg in started)


@pytest.mark.parametrize("learn", ["sampler", "joint", "task"])
@pytest.mark.parametrize(
    "change", ["task.resample=256", "task/net=pcrnet", "weights=pcrnet.modelnet40", "m=8"]
)
def test_changed_setting_changes_no_other(learn, change):
    chosen = ["task=registration", "sampler=fmops", f"learn={learn}"]
    before, after = (
        dotted(OmegaConf.to_container(compose(given), resolve=True))
        for given in (chosen, [*chosen, change])
    )
    different = {name for name in {**before, **after} if before.get(name) != after.get(name)}
    assert different <= {change.partition("=")[0]}


def test_fmops_for_registration_has_anchors_and_points_for_them():
    cfg = compose(["task=registration", "sampler=fmops"])
    assert (cfg.sampler.anchors, cfg.sampler.m_max, cfg.recipe.train_points) == ("fps", 64, 512)
    assert (cfg.weights, cfg.pretrain_from) == ("auto", "pcrnet.modelnet40")
    assert cfg.recipe.warm_start is True
    assert cfg.optimizer.lr == 1e-3
    plain = compose(["task=registration", "sampler=fmops", "recipe=paper"])
    assert (plain.sampler.anchors, plain.sampler.m_max) == (None, 64)
    assert compose(["sampler=fmops"]).sampler.m_max == 512


LEARN = ("task", "sampler", "joint", "nothing")


def test_user_files_need_no_specialised_file(tmp_path):
    own = {
        "sampler/mine": "_target_: mops_lightning.samplers.fps.FPSSampler\nm: ${m}\n",
        "task/ours": (
            "defaults:\n  - net: pointnet\n  - _self_\n"
            "_target_: mops_lightning.tasks.classification.Classification\n"
        ),
        "dataset/blobs": (
            "_target_: mops_lightning.data.shapes.shapes\nn_points: 64\ntrain_per_class: 4\n"
            "test_per_class: 3\nclasses: [chair, lamp]\nseed: ${seed}\n"
        ),
    }
    for name, text in own.items():
        (tmp_path / "own" / f"{name}.yaml").parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "own" / f"{name}.yaml").write_text(text)
    chosen = ["sampler=mine", "task=ours", "dataset=blobs"]
    tiny = [one for one in TINY if not one.startswith("dataset.")]
    status, _, err = call(["--config-dir", "own", *chosen, *tiny], tmp_path)
    assert status == 0, err
    (run,) = runs(tmp_path)
    assert run.relative_to(tmp_path / "outputs").as_posix().startswith("ours/blobs/mine-m8/")


def test_devices_inherit_the_default_trainer():
    default: Any = OmegaConf.to_container(compose().trainer)
    expected: dict[str, dict[str, Any]] = {
        "cpu": {"accelerator": "cpu"},
        "gpu": {"accelerator": "gpu"},
        "ddp": {"devices": "auto", "strategy": "ddp"},
    }
    for name, changes in expected.items():
        assert compose([f"trainer={name}"]).trainer == {**default, **changes}


def test_baselines_are_left_out_added_and_checked(tmp_path):
    given = ["baselines.voxel=null", "+sampler@baselines.poisson=poisson"]
    cfg = compose(given)
    check(cfg)
    assert [name for name, node in cfg.baselines.items() if node] == ["random", "fps", "poisson"]


@pytest.mark.parametrize(
    ("learn", "label"),
    [
        ("task", "pointnet"),
        ("sampler", "fmops-m512"),
        ("joint", "fmops-m512-joint"),
        ("nothing", "fmops-m512"),
    ],
)
def test_run_label_names_net_or_sampler(learn, label):
    cfg = compose([f"learn={learn}", "sampler=fmops", "+logger.name2=${run_label:}"])
    assert cfg.logger.name2 == label


@pytest.mark.parametrize("files", [2, 4])
def test_own_scans_needs_a_folder_and_gives_a_sampler_for_tiles(files, tmp_path):
    """Of two files, none is held out for early stopping."""
    (tmp_path / "scans").mkdir()
    for seed in range(files):
        points = np.random.default_rng(seed).normal(size=(300, 3)) + 1000
        np.save(tmp_path / "scans" / f"{seed}.npy", points)
    chosen = ["experiment=own_scans", "dataset.root=scans", "dataset.crops=4", "sizes=[8]"]
    chosen.append("trainer.check_val_every_n_epoch=1")
    status, _, err = call([*chosen, *TINY_ANY_DATA, "sampler.m_max=16"], tmp_path)
    assert status == 0, err
    (run,) = runs(tmp_path)
    metrics = read(run).validation
    assert ("val/completed/nre_cd" in metrics) == (files == 4)
    arguments = ["scans/0.npy", "small.npy", "--weights", str(run), "--tile", "64", "--m", "70"]
    status, out, err = call(["downsample", *arguments], tmp_path)
    assert (status, err) == (0, "")
    assert len(np.unique(np.load(tmp_path / "small.npy"), axis=0)) == 70
