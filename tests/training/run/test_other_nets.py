import shutil

import pytest

from mops_lightning.config.compose import compose
from mops_lightning.config.overrides import readable
from mops_lightning.errors import UserError
from mops_lightning.report.collect import sampler_row
from mops_lightning.training.evaluation import command_line
from mops_lightning.training.run.run import run
from mops_lightning.zoo import weights
from tests.support.command_line import job


def test_sampler_trained_under_several_nets(tmp_path):
    first = tmp_path / "net1"
    second = tmp_path / "net2"
    job(first, "learn=task", "seed=1", "dataset.seed=0")
    job(second, "learn=task", "seed=2", "dataset.seed=0")
    alone = job(tmp_path / "alone")
    both = f"other_nets=[{first},{second}]"
    resumed = f"ckpt_path={tmp_path / 'both'}"

    record = job(tmp_path / "both", both)

    assert sampler_row(record) == f"{sampler_row(alone)} 3 nets"
    assert record.metrics != alone.metrics
    assert record.metrics["test/full/accuracy"] == alone.metrics["test/full/accuracy"]

    # Another second net is another training.
    with pytest.raises(UserError, match=r"other settings .*other_nets\.2"):
        job(tmp_path / "new", f"other_nets=[{first}]", resumed)

    # And so is one under other weights in the same file.
    kept = (second / weights.FILE).read_bytes()
    shutil.copyfile(first / weights.FILE, second / weights.FILE)
    with pytest.raises(UserError, match=r"other settings \(other_nets\.2\)"):
        job(tmp_path / "newer", both, resumed)

    (second / weights.FILE).write_bytes(kept)
    again = job(tmp_path / "resumed", both, resumed)

    assert again.metrics == record.metrics

    for folder in (first, second):  # an evaluation needs none of them
        (folder / weights.FILE).unlink()
    given = [f"evaluate={tmp_path / 'both'}", "pictures=0", "logger=none"]
    chosen = [readable(argument) for argument in command_line(given)]
    evaluated = run(compose(chosen), tmp_path / "again", chosen)

    assert evaluated.metrics == record.metrics
    assert sampler_row(evaluated) == sampler_row(record)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("[nowhere]", ": no file or model .nowhere"),
        ("[mops.modelnet40-m32]", ": .* holds a sampler, not a task net"),
        ("[pcrnet.modelnet40]", ": .*net must take .points"),
        ("[pointnet.modelnet40]", ": .*has 40 classes, which are not the 3 classes"),
        ("pointnet.modelnet40", " must be null or a list of models or runs"),
    ],
)
def test_other_nets_that_cannot_be_used_raise(tmp_path, given, words):
    with pytest.raises(UserError, match=f"^other_nets{words}"):
        job(tmp_path / "run", f"other_nets={given}")


@pytest.mark.parametrize("given", [(), ("other_nets=[pointnet.modelnet40]",)])
def test_more_nets_per_step_than_other_nets_raise(tmp_path, given):
    with pytest.raises(UserError, match=f"nets_per_step=2: there are {len(given)} other"):
        job(tmp_path / "run", "recipe.nets_per_step=2", *given)
