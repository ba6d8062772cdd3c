import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.seeding import generator
from mops_lightning.training.checkpoint import Checkpoint, Ending
from mops_lightning.training.run.build import _lengthens, split
from tests.support.command_line import job
from tests.support.training import small_dataset


def rows(part, whole):
    """Rows of a part's clouds in the whole split."""
    numbers = []
    for cloud in part:
        is_same = (whole == cloud).all(2).all(1)
        numbers.append(int(is_same.nonzero()))
    return numbers


def test_split_holds_out_fraction_in_order():
    clouds = small_dataset(train=20).train

    train, held_out = split(clouds, 0.2, seed=5)

    kept = rows(train.points, clouds.points)
    out = rows(held_out.points, clouds.points)
    together = sorted([*kept, *out])
    assert len(out) == 4
    assert together == list(range(20))
    assert kept == sorted(kept)
    assert out == sorted(out)
    assert torch.equal(held_out.labels, clouds.labels[out])
    # The stream of random numbers stays, so that old runs can be repeated.
    order = torch.randperm(20, generator=generator(5, 2))
    assert out == sorted(order[:4].tolist())


@pytest.mark.parametrize(("fraction", "number"), [(0.19, 4), (0.21, 4), (1.0, 20)])
def test_split_holds_out_the_nearest_whole_number(fraction, number):
    clouds = small_dataset(train=20).train

    train, held_out = split(clouds, fraction, seed=5)

    assert len(held_out.points) == number
    assert len(train.points) == 20 - number


def test_split_of_no_share_holds_out_nothing():
    clouds = small_dataset(train=20).train

    train, held_out = split(clouds, 0.0, seed=5)

    assert len(train.points) == 20
    assert len(held_out.points) == 0


def test_split_holds_out_whole_sources():
    sources = torch.arange(5).repeat_interleave(4)
    clouds = small_dataset(train=20).train._replace(sources=sources)

    _, held_out = split(clouds, 0.4, seed=5)

    assert held_out.sources is not None
    _, counts = held_out.sources.unique(return_counts=True)
    assert counts.tolist() == [4, 4]


UNTOLD = Ending()
STOPPED = Ending(should_stop=True)


@pytest.mark.parametrize(
    ("planned", "epochs", "ending", "lengthens"),
    [
        (3, 3, UNTOLD, False),
        (3, 4, UNTOLD, True),
        (3, 2, UNTOLD, False),
        (3, 4, STOPPED, False),
        (-1, 5, UNTOLD, False),
        (3, -1, UNTOLD, False),
    ],
)
def test_training_is_lengthened_by_more_epochs_than_were_planned(
    planned, epochs, ending, lengthens, tmp_path
):
    resumed = Checkpoint(tmp_path, {}, planned, done=2, steps=2, ending=ending)

    assert _lengthens(resumed, epochs) == lengthens


def test_weights_for_a_net_without_any_are_refused(tmp_path):
    settings = ["task=registration", "task/net=plane_icp", "sampler=fps"]
    said = r"weights: plane_icp has no weights to load, got pcrnet\.modelnet40\. Give weights=null"

    with pytest.raises(UserError, match=said):
        job(tmp_path / "run", *settings, "weights=pcrnet.modelnet40")
