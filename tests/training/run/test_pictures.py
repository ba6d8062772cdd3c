"""What a run draws and saves of its test clouds."""

import torch

from mops_lightning.config.build import build
from mops_lightning.config.compose import compose
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run import pictures
from mops_lightning.training.run.make_experiment import make_experiment
from mops_lightning.training.run.pictures import (
    CloudVisualization,
    _Drawn,
    cloud_titles,
    clouds_to_draw,
)
from mops_lightning.viz import figures
from mops_lightning.viz.figures import load_clouds
from tests.support.command_line import TINY, job
from tests.support.training import small_dataset

SETTINGS = [
    "weights=null",
    "sampler=fmops",
    "sampler.m_max=16",
    "sizes=[4,16]",
    "pictures=3",
    "callbacks.pictures.up=z",
    "test_noise_std=0.01",
]


def noted_comparison(monkeypatch):
    """Collect what the comparison of methods is drawn from."""
    noted = []
    draw = figures.comparison

    def note(points, samples, captions):
        noted.append((points, samples, captions))
        return draw(points, samples, captions)

    monkeypatch.setattr(figures, "comparison", note)
    return noted


def test_run_draws_the_scores_of_all_methods_and_saves_clouds_with_y_up(tmp_path, monkeypatch):
    noted = noted_comparison(monkeypatch)
    monkeypatch.setattr(pictures, "DENSE_PIXELS", 64 * 8)

    record = job(tmp_path / "run", *SETTINGS)

    dataset = build(compose([*TINY, f"cache={tmp_path}/cache"]).dataset, "dataset")
    rows, titles = clouds_to_draw(dataset, 3)
    saved_titles, saved = load_clouds(tmp_path / "run" / "pictures" / "clouds.npz")
    assert saved_titles == titles == ["chair", "lamp", "vase"]
    assert list(saved) == ["input", "generated", "matched", "completed"]
    x, y, z = dataset.test.points[rows].unbind(2)
    upright = torch.stack([x, z, -y], 2)
    assert (torch.from_numpy(saved["input"]) - upright).abs().max() < 0.1  # the noise
    assert saved["matched"].shape == (3, 8, 3)
    distances = torch.cdist(
        torch.from_numpy(saved["matched"]),
        torch.from_numpy(saved["input"]),
    )
    assert distances.amin(2).max() < 1e-6

    ((points, samples, _),) = noted
    assert (points - dataset.test.points[rows[1]]).abs().max() < 0.1  # the one in the middle
    assert list(samples) == ["random", "voxel", "fps", "generated"]
    assert {len(sample) for sample in samples.values()} == {8}
    assert (tmp_path / "run" / "pictures" / "matrix.png").is_file()
    assert record.files["pictures"] == "pictures"
    assert record.files["clouds"] == "pictures/clouds.npz"


def test_captions_of_a_comparison_are_the_scores_of_the_drawn_size(tmp_path, monkeypatch):
    noted = noted_comparison(monkeypatch)
    dataset = small_dataset()
    settings = ["sampler=fmops", "sampler.m_max=16", "sizes=[4,16]", "m=8"]
    module = make_experiment(compose(settings), dataset, {})
    drawing = CloudVisualization(None, ["long", "tall", "round"], tmp_path)
    clouds = dataset.test.points[:3]
    samples = dict.fromkeys(("random", "fps", "generated"), clouds[:, :8])
    accuracies = {"m8/random": 0.25, "m8/generated": 0.5, "m4/generated": 0.125, "full": 0.75}
    scores = {}
    for name, accuracy in accuracies.items():
        scores[f"test/{name}/accuracy"] = torch.tensor(accuracy)

    drawing._comparison(module, clouds, samples, scores)

    ((points, drawn, captions),) = noted
    assert torch.equal(points, clouds[1])
    assert torch.equal(drawn["fps"], clouds[1, :8])
    assert captions == {
        "random": "random: 25.00 %",
        "fps": "fps",  # it has no score
        "generated": "FMOPSNet: 50.00 %",
        "full": "all points: 75.00 %",
    }


def test_drawing_keeps_the_mode_of_training_and_uses_that_of_evaluation(tmp_path, monkeypatch):
    modes = []
    whole = CloudVisualization._with_sampler

    def note(self, module, batch, methods, scores):
        modes.append((scores is None, module.training, module.sampler.training))
        if scores is None:
            return _Drawn({}, torch.zeros(1, 1, 3), {}, [])
        return whole(self, module, batch, methods, scores)

    monkeypatch.setattr(CloudVisualization, "_with_sampler", note)
    monkeypatch.setattr(pictures, "DENSE_PIXELS", 64 * 8 - 1)
    trained = note_modes_of_steps(monkeypatch)

    job(tmp_path / "run", *SETTINGS, "logger=tensorboard", "trainer.max_epochs=2")

    before = (True, False, False)
    after = (False, False, False)
    assert modes == [before, before, after]
    assert trained == [True] * 4
    assert (tmp_path / "run" / "pictures" / "comparison.png").is_file()
    assert not (tmp_path / "run" / "pictures" / "matrix.png").exists()  # too large


def note_modes_of_steps(monkeypatch):
    """Collect whether the sampler is in training mode in each step."""
    noted = []
    step = Experiment.training_step

    def note(self, batch, number):
        noted.append(self.sampler.training)
        return step(self, batch, number)

    monkeypatch.setattr(Experiment, "training_step", note)
    return noted


def test_titles_of_a_task_of_single_clouds_are_those_of_the_data():
    task = Classification(PointNetVanilla(3), 3)

    assert cloud_titles(task, ["chair", "vase"]) == ["chair", "vase"]
