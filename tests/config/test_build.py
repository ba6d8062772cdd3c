"""Objects from nodes, and whose name an error of a constructor starts with."""

import copy
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from mops_lightning.config.build import build
from mops_lightning.errors import UserError


class Part:
    def __init__(self, tau: float = 1.0, m: int = 1, inner: Any = None, text: str = "") -> None:
        if text:
            raise UserError(text)
        if tau <= 0:
            raise UserError(f"tau must be above 0, got {tau}.")
        if m < 1:
            raise UserError(f"m must be at least 1, got {m}.")
        self.inner = inner


def scale(value: float, factor: float) -> float:
    if factor < 0:
        raise UserError(f"factor must not be negative, got {factor}.")
    if value < 0:
        raise UserError(f"value must not be negative, got {value}.")
    return factor * value


PART = f"{__name__}.Part"


def sampler(**settings):
    return OmegaConf.create({"m": 0, "sampler": {"_target_": PART, **settings}}).sampler


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"tau": 0}, "sampler.tau must be above 0, got 0."),
        ({"m": 0}, "sampler.m must be at least 1, got 0."),
        ({"m": "${m}"}, "m must be at least 1, got 0."),
        ({"text": "sampler.tau must be above 0."}, "sampler.tau must be above 0."),
        ({"text": "tau: unknown 'x'."}, "sampler.tau: unknown 'x'."),
        ({"text": "tau.pt must be a file."}, "tau.pt must be a file."),
        ({"text": "points must be finite."}, "points must be finite."),
        ({"inner": {"_target_": PART, "tau": -1}}, "sampler.inner.tau must be above 0, got -1."),
    ],
)
def test_build_of_a_refused_argument_names_the_setting(settings, said):
    with pytest.raises(UserError) as caught:
        build(sampler(**settings), "sampler")
    assert str(caught.value) == said


def test_build_without_a_path_or_with_an_argument_from_code_names_the_argument():
    with pytest.raises(UserError, match=r"^tau must be"):
        build(sampler(tau=0))
    with pytest.raises(UserError, match=r"^m must be"):
        build(sampler(), "sampler", m=0)


def test_build_of_a_partial_function_names_the_setting_when_it_is_called():
    def made(factor):
        node = {"_target_": f"{__name__}.scale", "_partial_": True, "factor": factor}
        return build(OmegaConf.create(node), "optimizer.schedule")

    assert made(2.0)(3.0) == 6.0
    with pytest.raises(UserError, match=r"^optimizer\.schedule\.factor must not be negative"):
        made(-1.0)(3.0)
    with pytest.raises(UserError, match=r"^value must not be negative"):
        made(1.0)(-3.0)


def test_build_without_the_package_names_it():
    node = OmegaConf.create({"_target_": "no_such_package_here.Thing"})
    with pytest.raises(UserError, match="needs a package that is not installed"):
        build(node, "logger")


def test_build_partial_is_shared_by_copies_of_what_holds_it():
    node = OmegaConf.create({"_target_": "torch.optim.Adam", "lr": 0.1, "_partial_": True})
    makers = [build(node, "optimizer")]

    copied = copy.deepcopy(makers)

    assert copied[0] is makers[0]
    assert copied[0]([torch.zeros(1, requires_grad=True)]).defaults["lr"] == 0.1


def test_build_partial_holds_no_configuration_node():
    node = OmegaConf.create({"_target_": "torch.optim.Adam", "lr": 0.1, "_partial_": True})

    maker = build(node, "optimizer")

    assert not [value for value in vars(maker).values() if OmegaConf.is_config(value)]
