import json

import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from mops_lightning.metrics import classification, reconstruction, registration, sampled_set
from mops_lightning.metrics.base import TableMetric, collection
from mops_lightning.metrics.classification import Accuracy, MeanClassAccuracy
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.metrics.reconstruction import Distances
from mops_lightning.metrics.registration import RotationError, TranslationError
from mops_lightning.ops.rigid import Motion

METRICS = [
    value
    for module in (classification, reconstruction, registration, sampled_set)
    for value in vars(module).values()
    if isinstance(value, type) and issubclass(value, TableMetric) and hasattr(value, "name")
]


# What tables and records contain: name, title, 0.012345678 as text, whether higher is better, place
# in the closing table, name for full clouds.
SHOWN = """
accuracy: accuracy (%), 1.23, True, 1, None
mean_class_accuracy: mean class accuracy (%), 1.23, True, 2, None
mean_iou: mean IoU (%), 1.23, True, 1, None
point_accuracy: point accuracy (%), 1.23, True, 2, None
chamfer: chamfer, 0.01235, False, 3, None
emd: emd, 0.01235, False, 4, None
nre_cd: nre cd, 0.01235, False, 1, chamfer
nre_emd: nre emd, 0.01235, False, 2, emd
nre_cd_of_means: nre cd of means, 0.01235, False, None, chamfer
nre_emd_of_means: nre emd of means, 0.01235, False, None, emd
rotation_error_deg: rotation error (°), 0.01, False, 1, None
median_rotation_error_deg: median rotation error (°), 0.01, False, 0, None
rotation_error_p90_deg: rotation error p90 (°), 0.01, False, 2, None
rotation_error_doubled_deg: rotation error doubled (°), 0.01, False, None, None
rotation_recall_2deg: rotation recall 2deg (%), 1.23, True, 3, None
rotation_recall_5deg: rotation recall 5deg (%), 1.23, True, 3, None
rotation_recall_10deg: rotation recall 10deg (%), 1.23, True, 4, None
translation_error: translation error, 0.01235, False, 5, None
subset_distance: subset distance, 0.01235, False, None, None
unique_points: unique points, 0.01235, True, None, None
nonzero_percent: non-zero entries of S (%), 0.01, False, None, None
orthogonality_error: orthogonality error, 0.01235, False, None, None
"""


def shown(metric):
    info = MetricInfo.of(metric.name, metric)
    return (
        f"{info.name}: {info.title}, {info.format(0.012345678)}, {info.higher_is_better}, "
        f"{info.summary_order}, {info.full_cloud_metric}"
    )


def test_metrics_declare_what_tables_show():
    assert [shown(metric) for metric in METRICS] == SHOWN.strip().splitlines()


def test_info_survives_json():
    info = MetricInfo("a", "b", "c", 2.0, True, None, "d")
    assert MetricInfo.from_dict("a", json.loads(json.dumps(info.as_dict()))) == info
    assert MetricInfo("a").as_dict() == {}


def test_info_has_the_name_of_the_key_in_the_collection():
    info = MetricInfo.of("of_chairs", Accuracy(3))

    assert info.name == "of_chairs"
    assert info.title == "of chairs (%)"


@pytest.mark.parametrize("metric", METRICS)
def test_metric_documents_itself(metric):
    assert "__doc__" in vars(metric)


def batch(metric):
    """What a metric is updated with."""
    quaternion = torch.tensor([[1.0, 0.01, 0, 0]])
    turned = Motion(F.normalize(quaternion), torch.rand(1, 3))
    still = Motion(torch.eye(4)[:1], torch.rand(1, 3))
    distances = Distances(torch.rand(3), torch.rand(3))
    reference = Distances(torch.rand(3), torch.rand(3))
    logits = torch.eye(3)
    labels = torch.tensor([0, 1, 1])
    given = {
        "classification": (logits, labels),
        "reconstruction": (distances, reference),
        "registration": (turned, still),
        "sampled_set": (torch.rand(3),),
    }
    module = metric.__module__.rpartition(".")[2]
    return given[module]


@pytest.mark.parametrize("metric", METRICS)
def test_metric_of_two_processes_with_equal_data_equals_that_of_one(metric):
    def state_of_both_processes(state, group=None):
        return [state, state]

    def is_distributed():
        return True

    classes: tuple[int, ...] = ()
    if metric.__module__ == classification.__name__:
        classes = (3,)
    alone = metric(*classes)
    shared = metric(
        *classes,
        dist_sync_fn=state_of_both_processes,
        distributed_available_fn=is_distributed,
    )
    given = batch(metric)

    alone.update(*given)
    shared.update(*given)

    value = alone.compute()
    assert_close(shared.compute(), value)
    assert value > 0


def test_collection_metrics_equal_after_first_batch_stay_apart():
    no_shift = torch.zeros(1, 3)
    still = Motion(torch.tensor([[1.0, 0.0, 0.0, 0.0]]), no_shift)
    half_turn = Motion(torch.tensor([[0.0, 1.0, 0.0, 0.0]]), no_shift)
    metrics = collection(RotationError(), TranslationError(), TwiceTheError())

    metrics.update(still, still)
    metrics.update(half_turn, still)

    found = metrics.compute()
    assert set(found) == {"rotation_error_deg", "translation_error", "twice"}
    assert found["rotation_error_deg"] == pytest.approx(90, abs=1e-3)
    assert found["translation_error"] == pytest.approx(0, abs=1e-3)
    assert found["twice"] == pytest.approx(180, abs=1e-3)


class TwiceTheError(TranslationError):
    """Has the state of another metric until the first error."""

    name = "twice"

    def update(self, predicted, true):
        self.add(2 * RotationError.of(predicted, true))


def test_accuracy_over_batches_matches_hand_computed_value():
    labels = torch.tensor([0, 0, 0, 1, 2, 2])
    answers = torch.tensor([0, 0, 1, 1, 2, 0])
    logits = F.one_hot(answers, 3).float()
    accuracy = Accuracy(3)
    mean_class = MeanClassAccuracy(3)

    for metric in (accuracy, mean_class):
        metric.update(logits[:2], labels[:2])
        metric.update(logits[2:], labels[2:])

    mean_of_classes = (2 / 3 + 1 + 1 / 2) / 3
    assert accuracy.compute() == pytest.approx(4 / 6)
    assert mean_class.compute() == pytest.approx(mean_of_classes)
