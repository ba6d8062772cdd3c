from dataclasses import replace
from typing import Any

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.training.run.cloud_sizes import check_processes, smallest_cloud
from tests.support.training import small_dataset


def with_sizes(clouds, sizes):
    return clouds._replace(sizes=torch.tensor(sizes))


@pytest.mark.parametrize("split", ["train", "test"])
def test_clouds_of_different_sizes_need_one_process(split):
    dataset = small_dataset(train=4, test=4)
    sizes: dict[str, Any] = {split: with_sizes(getattr(dataset, split), [48, 20, 48, 30])}

    check_processes(dataset, 2)
    check_processes(replace(dataset, **sizes), 1)
    with pytest.raises(UserError, match=r"trainer\.devices must be 1 with clouds of .* got 2\."):
        check_processes(replace(dataset, **sizes), 2)


def test_smallest_cloud_is_found_in_all_splits():
    dataset = small_dataset(train=4, test=4)
    train = with_sizes(dataset.train, [48, 48, 20, 30])
    test = with_sizes(dataset.test, [48, 30, 48, 48])

    cloud = smallest_cloud((test, train), None)

    assert torch.equal(cloud, dataset.train.points[2:3, :20])
