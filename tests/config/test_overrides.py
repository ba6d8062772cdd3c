import pytest

from mops_lightning.config import overrides
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError


@pytest.mark.parametrize(
    ("argument", "key", "path"),
    [
        ("m=8", "m", "m"),
        ("++sampler.alpha=3", "sampler.alpha", "sampler.alpha"),
        ("~task.resample", "task.resample", "task.resample"),
        ("task/net=pcrnet", "task/net", "task.net"),
        ("optimizer@pretrain=x", "optimizer@pretrain", "pretrain"),
        ("m=4,8", "m", "m"),
        ("out=it's (1), = ~", "out", "out"),
        ("--cfg", "", ""),
        ("job", "", ""),
    ],
)
def test_key_and_path_of_an_argument(argument, key, path):
    assert (overrides.key(argument), overrides.path(argument)) == (key, path)


@pytest.mark.parametrize("text", ["a/b=0.1", "~/runs", "it's (1), a \\ run", "plain/path", "a b"])
def test_value_is_read_as_typed(text):
    for argument in (f"out={text}", f"out={overrides.quote(text)}"):
        override = overrides.parse_override(argument)
        assert override is not None
        assert override.value() == text
        assert compose([overrides.readable(argument)]).out == text


def test_own_class_chooses_the_group_of_own_and_takes_any_setting():
    given = ["sampler._target_=my.Sampler", "sampler.width=3", "m=8", "task.net.dropout=0"]
    assert overrides.with_own_classes(given) == [
        "++sampler._target_=my.Sampler",
        "++sampler.width=3",
        "m=8",
        "task.net.dropout=0",
        "sampler=own",
    ]
    kept = ["sampler=mops", "sampler._target_=my.MOPSNet", "~sampler.overlap"]
    assert overrides.with_own_classes(kept) == [kept[0], f"++{kept[1]}", kept[2]]


def test_home_folder_is_known_by_its_tilde(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    for key in ("out", "hydra.run.dir", "hydra.sweep.dir"):
        assert overrides.with_home(f"{key}=~/a=b") == f"{key}='/home/me/a=b'"
        with pytest.raises(UserError, match=f"^{key}=~nosuchuser: no user has this name"):
            overrides.with_home(f"{key}=~nosuchuser")
    for other in ("out=a/~", "out=choice(~/a,~/b)", "~out", "weights=~/x", "--cfg"):
        assert overrides.with_home(other) == other
