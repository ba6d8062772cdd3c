"""The groups of conf/: what one run's configuration shows, and what depends on several groups."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from mops_lightning.cli.main import COMMANDS
from mops_lightning.config.compose import compose
from mops_lightning.config.groups import conf_dir
from mops_lightning.config.settings import declared
from mops_lightning.records.run_record import read
from mops_lightning.tree import dotted
from tests.support.command_line import TINY, TINY_ANY_DATA, call, done, runs
from tests.support.small_data import write_airborne

composed = cache(lambda chosen: compose(chosen.split()))
"""What several tests read and none changes."""
TASKS = ("classification", "registration", "reconstruction")


@pytest.mark.parametrize(
    "chosen", [[], ["task=reconstruction", "sampler=fmops"], ["task=registration", "sampler=fmops"]]
)
def test_run_is_described_in_120_lines(chosen, tmp_path):
    status, out, err = call([*chosen, "--cfg", "job", "m=64"], tmp_path)
    assert (status, err) == (0, "")
    assert "m: 64" in out.splitlines()
    assert len(out.splitlines()) <= 120


def test_help_alone_is_the_text_that_hydra_makes(tmp_path):
    alone = call(["--help"], tmp_path)
    by_hydra = call(["--help", "m=8"], tmp_path)

    assert alone == by_hydra


def test_help_shows_every_key_and_choice(tmp_path):
    _, out, _ = call(["--help"], tmp_path)
    for name, setting in declared().items():
        text = " ".join(out.split())
        assert setting.group or f"{name} {setting.help}" in text
    for group in ("sampler", "task/net", "dataset", "recipe", "experiment"):
        names = sorted(path.stem for path in conf_dir().joinpath(group).glob("*.yaml"))
        assert f"\n{group}: {', '.join(names)}\n" in out
    assert all(f"\n{name} " in out.partition("sampler:")[0] for name in COMMANDS)
    hidden = ("sampler/", "sampler_recipe", "dataset_task", "task_settings")
    assert not any(line.startswith(hidden) for line in out.splitlines())


def test_no_default_is_computed_from_other_choices():
    for path in conf_dir().rglob("*.yaml"):
        text = path.read_text().replace("${task}_${oc.select:recipe,none}", "")  # a file's name
        assert not any(word in text for word in ("choose:", "model_for:", "oc.select")), path


def test_only_presets_set_keys_of_other_groups():
    names = [
        path.relative_to(conf_dir()).as_posix()
        for path in conf_dir().rglob("*.yaml")
        if "@package _global_" in path.read_text()
    ]
    assert names
    assert {name.split("/")[0] for name in names} == {"experiment", "debug"}


FOLLOWING = """
: m=32 batch_size=32 learn=sampler weights=auto names.task=classification names.net=pointnet
: names.dataset=shapes names.sampler=mops names.recipe=fast epochs.task=12 epochs.sampler=10
: sampler.alpha=30.0 sampler.tau_min=0.1 task_lr_scale=1.0
sampler=fmops: sampler.alpha=30.0 sampler.tau_min=0.1 sampler.m_max=512 optimizer.lr=0.001
sampler=fmops recipe=paper: sampler.size_sampling=uniform
task=registration: sampler.alpha=1.0 sampler.tau_min=0.1 task_lr_scale=0.1
task=registration: epochs.task=6 epochs.sampler=6
task=registration: names.net=pcrnet task.net.iterations=2
task=registration sampler=fmops: sampler.alpha=1.0 sampler.tau_min=0.1 sampler.anchors=framed
task=registration sampler=fmops: sampler.m_max=64 recipe.train_points=256 recipe.warm_start=True
task=registration sampler=fmops: sampler.anchors=framed sampler.anchor_width=2.0
task=registration sampler=fmops: recipe.feature_distillation=0.0
task=registration sampler=mops: recipe.feature_distillation=1.0
task=registration sampler=fmops: weights=auto pretrain_from=pcrnet.modelnet40 optimizer.lr=0.005
task=registration sampler=fmops recipe=paper: sampler.anchors=None sampler.m_max=64
task=registration sampler=fmops recipe=paper: optimizer.lr=0.001
task=registration: recipe.train_points=256 recipe.task_points=128
task=registration recipe=paper: recipe.train_points=None recipe.task_points=None
task=registration dataset=modelnet40: recipe.train_points=512 recipe.task_points=None
task=reconstruction: sampler.alpha=0.2 sampler.tau_min=0.5
task=reconstruction: names.net=autoencoder
task=segmentation: names.net=hierarchical_segmentation task.net.sampler.m=32
task=icp dataset=clouds dataset.root=x: names.net=plane_icp
task=reconstruction sampler=fmops: sampler.alpha=0.2 sampler.tau_min=0.5
sampler=snet: optimizer.lr=0.01 pretrain.lr=0.001
sampler=snet optimizer=exponential: optimizer.lr=0.0005
learn=joint sampler=snet: optimizer.lr=0.01 pretrain.lr=0.001
task=registration sampler=snet: optimizer.lr=0.001 pretrain.lr=0.0005
task=reconstruction sampler=snet: optimizer.lr=0.0005 pretrain.lr=0.001
task=registration sampler=snet: sampler.alpha=0.01 sampler.output_norm=False sampler.coverage=1.0
task=reconstruction sampler=snet: sampler.alpha=0.01 sampler.coverage=0.0 sampler.head_norm=False
task=registration sampler=samplenet: sampler.alpha=0.01 sampler.k=8 sampler.beta=0.01
task=registration sampler=samplenet_progressive: sampler.alpha=0.01 sampler.k=8
task=registration sampler=samplenet_progressive: sampler.coverage=1.0 sampler.size_reduction=mean
task=reconstruction sampler=samplenet: sampler.alpha=0.01 sampler.coverage=0.0 sampler.k=16
task=reconstruction sampler=samplenet_progressive: sampler.alpha=0.01 sampler.coverage=0.0
task=reconstruction sampler=samplenet_progressive: sampler.k=16 sampler.min_size=16
task=registration sampler=fmops: sampler.num_sizes=2 sampler.min_size=8
sampler=fmops: sampler.num_sizes=4 sampler.min_size=8 sampler.size_sampling=nested
sampler=samplenet_progressive: sampler.m_max=1024 sampler.min_size=2 sampler.size_reduction=sum
sampler=samplenet_progressive: sampler.coverage=0.5 sampler.coverage_per_point=0.03333333333333333
dataset=modelnet40: epochs.task=30 epochs.sampler=8
dataset=modelnet40 task=reconstruction: epochs.task=200 epochs.sampler=60
dataset=shapenet_core task=reconstruction: epochs.task=100 epochs.sampler=30
dataset=clouds dataset.root=x task=reconstruction: epochs.task=100 epochs.sampler=30
experiment=own_scans dataset.root=x: epochs.task=60 epochs.sampler=90
experiment=reconstruction_paper: epochs.task=400 epochs.sampler=250
experiment=classification_paper: sampler.tau_min=0.1 sampler.alpha=30.0 optimizer.lr=0.0005
experiment=classification_paper: optimizer.schedule.end_lr=1e-05 trainer.max_epochs=250
experiment=classification_paper: names.dataset=modelnet40 val_fraction=0.0
experiment=classification_paper sampler=fmops: sampler.size_sampling=uniform
experiment=classification_snet sampler=samplenet: sampler.k=7 sampler.beta=1.0 sampler.alpha=30.0
experiment=classification_snet sampler=samplenet: sampler.sigma_min=0.0 sampler.coverage=1.0
experiment=classification_snet sampler=samplenet: sampler.coverage_per_point=0.0 optimizer.lr=0.01
experiment=classification_snet sampler=samplenet: optimizer.schedule.every=18750
experiment=classification_snet sampler=samplenet: optimizer.schedule.floor_lr=1e-05
experiment=classification_snet sampler=samplenet: trainer.max_epochs=500 val_fraction=0.0
"""
"""Settings, and the values that others have then."""


@pytest.mark.parametrize("line", FOLLOWING.strip().splitlines())
def test_values_follow_from_the_chosen_groups(line):
    chosen, values = line.split(": ")
    cfg = composed(chosen)
    for value in values.split():
        path, _, expected = value.partition("=")
        assert str(OmegaConf.select(cfg, path)) == expected, path


@pytest.mark.parametrize("task", TASKS)
def test_length_follows_from_what_is_learned(task):
    cfg, lengths = compose([f"task={task}"]), {}
    for cfg.learn in LEARN:  # Hydra chooses no group by it
        lengths[cfg.learn] = cfg.trainer.max_epochs
    epochs = {"task": cfg.epochs.task, "sampler": cfg.epochs.sampler}
    assert lengths == {**epochs, "joint": cfg.epochs.sampler, "nothing": 0}


@pytest.mark.parametrize("sampler", ["mops", "fmops"])
@pytest.mark.parametrize(
    ("setting", "spellings"),
    [
        ("weights", "auto pcrnet.modelnet40 models/pcrnet.modelnet40.safetensors null"),
        ("recipe.warm_start", "true fmops.airplane-m256 models/fmops.airplane-m256.safetensors"),
    ],
)
def test_spelling_of_weights_changes_nothing_else(sampler, setting, spellings):
    chosen = ["task=registration", f"sampler={sampler}"]
    found: list[Any] = [compose([*chosen, f"{setting}={name}"]) for name in spellings.split()]
    for cfg in found:
        OmegaConf.update(cfg, setting, "the same")
    assert all(cfg == found[0] for cfg in found)


@pytest.mark.parametrize("learn", ["sampler", "joint", "task"])
@pytest.mark.parametrize(
    "change", ["task.resample=256", "task/net=pcrnet", "weights=pcrnet.modelnet40", "m=8"]
)
def test_changed_setting_changes_no_other(learn, change):
    chosen = f"task=registration sampler=fmops learn={learn}"
    before, after = (
        dotted(OmegaConf.to_container(composed(given), resolve=True))
        for given in (chosen, f"{chosen} {change}")
    )
    different = {name for name in {**before, **after} if before.get(name) != after.get(name)}
    assert different <= {change.partition("=")[0]}


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
    done(["--config-dir", "own", *chosen, *tiny], tmp_path)
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


@pytest.mark.parametrize(
    ("run", "label"),
    [
        ("outputs/noise/fmops-m512", "noise-fmops-m512"),
        ("../outputs/noise/cell/", "noise-cell"),
        ("fmops.modelnet40-m512", "fmops.modelnet40-m512"),
        (None, "fps-m32"),
    ],
)
def test_tested_label_names_the_sweep_and_the_cell_of_the_tested_run(run, label):
    cfg = compose(["sampler=fps", "+logger.tested=${tested_label:}"])

    cfg.evaluate = run

    assert cfg.logger.tested == label


def test_tested_label_names_another_size_only_if_it_is_given():
    cfg = compose(["sampler=fps", "m=16", "+logger.tested=${tested_label:}"])

    cfg.evaluate = "fmops.modelnet40-m512"

    assert cfg.logger.tested == "fmops.modelnet40-m512-m16"


def test_labels_name_own_samplers_by_their_class():
    own = "sampler._target_=mops_lightning.samplers.fps.FPSSampler"
    labels = ["+logger.one=${run_label:}", "+logger.two=${sampler_label:}"]

    cfg = compose([own, "m=8", *labels])

    assert (cfg.logger.one, cfg.logger.two) == ("FPSSampler-m8", "FPSSampler")


def test_las_segmentation_learns_ground_and_scores_all_points(tmp_path):
    for number in range(3):
        write_airborne(tmp_path / "scans" / "train" / f"{number}.las", number)
    write_airborne(tmp_path / "scans" / "test" / "3.las", 3)
    small = ["dataset.n_points=256", "m=32", "task.net.points=[32,8]", "batch_size=4"]
    chosen = ["experiment=las_segmentation", "dataset.root=scans", *small]

    done([*chosen, "trainer=cpu", "logger=none", "pictures=0", "epochs.joint=12"], tmp_path)

    (run,) = runs(tmp_path)
    record = read(run)
    assert record.part_names == ["1", "2"]
    assert record.test_clouds == 4
    assert record.score_name == "test/sampled/mean_iou"
    assert record.score is not None
    assert record.score > 0.7


@pytest.mark.parametrize("files", [2, 4])
def test_own_scans_needs_a_folder_and_gives_a_sampler_for_tiles(files, tmp_path):
    """Of two files, none is held out for early stopping."""
    (tmp_path / "scans").mkdir()
    for seed in range(files):
        points = np.random.default_rng(seed).normal(size=(300, 3)) + 1000
        np.save(tmp_path / "scans" / f"{seed}.npy", points)
    chosen = ["experiment=own_scans", "dataset.root=scans", "dataset.crops=4", "sizes=[8]"]
    chosen.append("trainer.check_val_every_n_epoch=1")
    done([*chosen, *TINY_ANY_DATA, "sampler.m_max=16"], tmp_path)
    (run,) = runs(tmp_path)
    record = read(run)
    assert ("val/completed/nre_cd" in record.validation) == (files == 4)
    assert record.dataset_facts["train_files"] + record.dataset_facts["test_files"] == files
    arguments = ["scans/0.npy", "small.npy", "--weights", str(run), "--tile", "64", "--m", "70"]
    status, out, err = call(["downsample", *arguments], tmp_path)
    assert (status, err) == (0, "")
    assert len(np.unique(np.load(tmp_path / "small.npy"), axis=0)) == 70


@pytest.mark.parametrize(
    ("chosen", "label"),
    [
        ("sampler=mops sampler.anchors=fps", "mops-anchored-m32"),
        ("sampler=mops sampler.anchors=fps learn=joint", "mops-anchored-m32-joint"),
        ("sampler=fps m=7", "fps-m7"),
        ("sampler=fps evaluate=run", "fps-evaluated"),
        ("learn=task evaluate=run task/net=dgcnn", "dgcnn"),
    ],
)
def test_run_label_says_what_distinguishes_runs(chosen, label):
    cfg = compose([*chosen.split(), "+logger.name2=${run_label:}"])

    assert cfg.logger.name2 == label
