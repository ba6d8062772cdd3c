"""Which test clouds are drawn."""

from dataclasses import replace

import torch

from mops_lightning.training.run.pictures import clouds_to_draw
from tests.support.training import small_dataset


def test_clouds_to_draw_spreads_over_the_classes():
    dataset = small_dataset()

    chosen, names = clouds_to_draw(dataset, 2)

    assert names == ["long", "round"]
    assert dataset.test.labels[chosen].tolist() == [0, 2]
    assert chosen.tolist() == [0, 2]  # the first of each class

    _, name_of_one = clouds_to_draw(dataset, 1)

    assert name_of_one == ["long"]


def test_clouds_to_draw_of_few_classes_spreads_over_the_clouds_of_each():
    dataset = small_dataset()  # rows 0, 3, 6 and 9 are long, 1, 4 and 7 tall, 2, 5 and 8 round

    chosen, names = clouds_to_draw(dataset, 5)

    assert chosen.tolist() == [0, 9, 1, 7, 2]
    assert names == ["long 1", "long 2", "tall 1", "tall 2", "round"]
    assert len(clouds_to_draw(dataset, 99)[0]) == 10


def test_clouds_to_draw_of_one_class_are_of_several_files():
    dataset = small_dataset()
    files = torch.tensor([0, 0, 0, 0, 1, 1, 1, 2, 2, 2])
    labels = torch.zeros(10, dtype=torch.int64)
    crops = dataset.test._replace(labels=labels, sources=files)
    of_one_class = replace(dataset, class_names=("cloud",), test=crops)

    chosen, names = clouds_to_draw(of_one_class, 3)

    assert files[chosen].tolist() == [0, 1, 2]
    assert names == ["cloud 1", "cloud 2", "cloud 3"]


def test_clouds_to_draw_of_no_cloud_is_empty():
    chosen, names = clouds_to_draw(small_dataset(), 0)

    assert len(chosen) == 0
    assert names == []


def test_clouds_to_draw_leaves_out_classes_without_test_clouds():
    dataset = small_dataset()
    is_not_long = dataset.test.labels != 0
    test = dataset.test.take(is_not_long)

    chosen, names = clouds_to_draw(replace(dataset, test=test), 3)

    assert names == ["tall 1", "tall 2", "round"]
    assert test.labels[chosen].tolist() == [1, 1, 2]
