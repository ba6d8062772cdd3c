"""The same samples under task nets that had no part in the training."""

import pytest
import torch
from omegaconf import open_dict

from mops_lightning.config.build import build
from mops_lightning.config.compose import compose
from mops_lightning.config.overrides import accepted
from mops_lightning.errors import UserError
from mops_lightning.nets.dgcnn import DGCNN
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import PointNetTransform, PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.factory import make_experiment
from mops_lightning.training.replay import command_line
from mops_lightning.training.run import run
from mops_lightning.training.task_nets import add_task_nets
from mops_lightning.zoo import weights
from tests.support.command_line import TINY
from tests.support.training import quick_classifier

CLASSES = ("chair", "lamp", "vase")
MODULE = "mops_lightning.nets"
NETS = {
    "own": (PointNetVanilla, 0),
    "pointnet": (PointNetVanilla, 1),
    "transform": (PointNetTransform, 0),
    "dgcnn": (DGCNN, 2),
}


def save_net(path, net, seed=0, classes=CLASSES, **changes):
    """Write the weights file of a classifier as a run with ``learn=task`` does."""
    target = f"{type(net).__module__}.{type(net).__qualname__}"
    config = {
        "learn": "task",
        "seed": seed,
        "names": {"task": "classification", "dataset": "shapes"},
        "task": {"net": {"_target_": target}},
        "trainer": {"max_epochs": 7},
        **changes,
    }
    task = Classification(net, 3)
    weights.save(path, task, config, {"test/full/accuracy": 0.75}, classes)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of MOPS-Net, and four task nets, one of which is the run's own."""
    folder = tmp_path_factory.mktemp("transfer")
    data = build(compose(TINY).dataset)
    for name, (cls, seed) in NETS.items():
        torch.manual_seed(seed)
        save_net(folder / f"{name}.pt", quick_classifier(cls(3), data.train), seed)
    overrides = [*TINY, "sampler=mops", f"weights={folder}/own.pt"]
    run(compose(overrides), folder / "run", overrides)
    return folder


def evaluating(folder, nets, *arguments):
    given = f"task_nets=[{','.join(map(str, nets))}]"
    fixed = [f"evaluate={folder}/run", "pictures=0", "logger=none", given]
    return [accepted(one) for one in command_line([*fixed, *arguments])]


@pytest.fixture(scope="module")
def record(folder):
    chosen = evaluating(folder, [folder / f"{name}.pt" for name in NETS], "sizes=[8]")
    return run(compose(chosen), folder / "evaluated", chosen)


def under(record, label):
    """Return the scores under one net, by the names of those under the run's own."""
    start = f"transfer/{label}/"
    metrics = record.metrics.items()
    return {f"test/{name.removeprefix(start)}": v for name, v in metrics if name.startswith(start)}


def test_run_own_net_gives_same_scores(record):
    found = under(record, "pointnet seed 0")
    readouts = ("generated", "matched", "completed", "random", "voxel", "fps", "full")
    assert {name.split("/")[-2] for name in found} == set(readouts)
    assert found == {name: record.metrics[name] for name in found}


def test_other_nets_give_other_scores(record):
    scores = [under(record, label) for label in record.task_nets]
    assert len(scores) == 4
    assert len({tuple(one.values()) for one in scores}) == 4
    assert all(one["test/full/accuracy"] > 0.4 for one in scores)


def test_full_score_is_that_of_net_alone(record, folder):
    net = DGCNN(3)
    state = weights.read(folder / "dgcnn.pt")["state"]
    net.load_state_dict({name.removeprefix("net."): value for name, value in state.items()})
    test = build(compose(TINY).dataset).test
    with torch.no_grad():
        right = (net.eval()(test.points).argmax(1) == test.labels).float().mean()
    assert record.metrics["transfer/dgcnn seed 2/full/accuracy"] == pytest.approx(float(right))


def test_notes_describe_nets(record, folder):
    notes = record.task_nets
    assert set(notes) == {
        "pointnet seed 0",
        "pointnet seed 1",
        "pointnet_transform seed 0",
        "dgcnn seed 2",
    }
    assert notes["dgcnn seed 2"] == {
        "file": str(folder / "dgcnn.pt"),
        "net": "dgcnn",
        "seed": 2,
        "sha256": weights.read(folder / "dgcnn.pt")["sha256"],
        "learn": "task",
        "max_epochs": 7,
        "dataset": "shapes",
        "recorded_score": 0.75,
    }


def test_scores_of_run_are_unchanged(record, folder):
    chosen = command_line([f"evaluate={folder}/run", "pictures=0", "logger=none"])
    plain = run(compose(chosen), folder / "plain", chosen)
    ours = {name: v for name, v in record.metrics.items() if not name.startswith("transfer/")}
    assert plain.metrics == ours
    assert (plain.score, bool(plain.task_nets)) == (record.score, False)


@pytest.fixture(scope="module")
def add(folder):
    """Load nets into the experiment of an evaluated run, without a test of it."""
    cfg = compose(evaluating(folder, ["unused"]))
    data = build(cfg.dataset)

    def added(*paths):
        with open_dict(cfg):
            cfg.task_nets = [str(path) for path in paths]
        experiment = make_experiment(cfg, data, {})
        return add_task_nets(experiment, cfg, data), experiment

    return added


def test_same_kind_and_seed_are_told_apart_by_hash(add, folder, tmp_path):
    other = save_net(tmp_path / "other.pt", PointNetVanilla(3), seed=1)
    notes, _ = add(folder / "pointnet.pt", other)
    assert list(notes) == [f"pointnet seed 1 ({note['sha256'][:8]})" for note in notes.values()]


def test_nets_stay_frozen(add, folder):
    _, experiment = add(folder / "pointnet.pt")
    experiment.train()
    assert not any(part.training for part in experiment.transfer.modules())
    assert not any(part.requires_grad for part in experiment.transfer.parameters())
    assert not experiment.trainable


def test_run_folder_gives_its_task_net(add, folder, tmp_path):
    joint = tmp_path / "joint"
    joint.mkdir()
    save_net(joint / "task_weights.pt", PointNetVanilla(3), seed=5, learn="joint")
    save_net(tmp_path / weights.FILE, PointNetVanilla(3), seed=6)
    notes, _ = add(joint, tmp_path)
    assert list(notes) == ["pointnet seed 5", "pointnet seed 6"]


def node(target, **arguments):
    return {"task": {"net": {"_target_": target, **arguments}}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"learn": "sampler"}, "holds a sampler, not a task net.*learn=task"),
        ({"names": {"task": "registration"}}, "for registration, not for classification"),
        ({"classes": ("chair", "bed", "vase")}, "classes, which are not the 3 classes"),
        (node("os.system"), "task.net._target_ must be a task net.*'os.system'"),
        (node(f"{MODULE}.icp.ICP"), "task.net._target_ must be a task net"),
        (node(f"{MODULE}.dgcnn.DGCNN"), "another net's weights"),
        (node(f"{MODULE}.dgcnn.DGCNN", k="many"), "task.net.k must be a whole number, got 'many'"),
        (node(f"{MODULE}.pointnet.PointNetVanilla", dropout=7), "cannot build .*dropout"),
        (node(f"{MODULE}.pointnet.PointNetVanilla", colour=1), "cannot build .*colour"),
        (node(f"{MODULE}.pcrnet.PCRNet"), "another net's weights"),
    ],
)
def test_wrong_file_raises(add, tmp_path, changes, words):
    path = save_net(tmp_path / "net.pt", PointNetVanilla(3), **changes)
    with pytest.raises(UserError, match=rf"^task_nets: {path}.*{words}"):
        add(path)


def test_net_of_other_arguments_raises(add, tmp_path):
    """A net that says it is a classifier, and takes pairs."""
    content = weights.read(save_net(tmp_path / "net.pt", PointNetVanilla(3)))
    config = {**content["config"], **node(f"{MODULE}.pcrnet.PCRNet")}
    weights.save(tmp_path / "net.pt", PCRNet(), config, {})
    with pytest.raises(UserError, match=r"^task_nets: .*net\.pt: .*net must take .*got PCRNet"):
        add(tmp_path / "net.pt")


def test_missing_file_or_net_given_twice_raises(add, folder, tmp_path):
    with pytest.raises(UserError, match=r"^task_nets: no file .*nowhere\.pt"):
        add(tmp_path / "nowhere.pt")
    first = folder / "own.pt"
    with pytest.raises(UserError, match="task_nets must name each net once, got"):
        add(first, first)
    copy = tmp_path / "copy.pt"
    copy.write_bytes(first.read_bytes())
    with pytest.raises(UserError, match=f"once: {first} and {copy} hold the same"):
        add(first, copy)
