"""Which test clouds are drawn."""

from dataclasses import replace

from mops_lightning.training.run.pictures import clouds_to_draw
from tests.support.training import small_dataset


def test_clouds_to_draw_spreads_over_the_classes():
    dataset = small_dataset()

    chosen, names = clouds_to_draw(dataset, 2)

    assert names == ["long", "round"]
    assert dataset.test.labels[chosen].tolist() == [0, 2]
    assert chosen.tolist() == [0, 2]  # the first of each class
    assert clouds_to_draw(dataset, 9)[1] == ["long", "tall", "round"]
    assert clouds_to_draw(dataset, 1)[1] == ["long"]


def test_clouds_to_draw_of_no_cloud_is_empty():
    assert clouds_to_draw(small_dataset(), 0)[1] == []


def test_clouds_to_draw_leaves_out_classes_without_test_clouds():
    dataset = small_dataset()
    test = dataset.test.take(dataset.test.labels != 0)

    chosen, names = clouds_to_draw(replace(dataset, test=test), 3)

    assert names == ["tall", "round"]
    assert test.labels[chosen].tolist() == [1, 2]
