"""Construction of modules that a file describes, without effect on other threads."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

TEMPORARY = 100
"""Tensors that a constructor may make besides two for every tensor of the file."""

RANDOM = frozenset(
    {
        "bernoulli",
        "bernoulli_",
        "cauchy_",
        "exponential_",
        "geometric_",
        "kaiming_normal_",
        "kaiming_uniform_",
        "log_normal_",
        "multinomial",
        "normal",
        "normal_",
        "orthogonal_",
        "poisson",
        "rand",
        "rand_like",
        "randint",
        "randint_like",
        "randn",
        "randn_like",
        "random_",
        "randperm",
        "sparse_",
        "trunc_normal_",
        "uniform_",
        "xavier_normal_",
        "xavier_uniform_",
    }
)
"""Functions of torch that draw random numbers and take a generator."""


class Construction(TorchFunctionMode):
    """Limits on a constructor, in the thread that calls it and nowhere else.

    A small file can describe a net of a million layers: the number of tensors is limited by the
    number in the file. Initial weights are replaced by those of the file: they are drawn from a
    generator of their own, so that torch's global random state stays as it is.

    Args:
        tensors: number of tensors in the file.

    Raises:
        ValueError: the constructor makes more tensors.
    """

    def __init__(self, tensors: int) -> None:
        super().__init__()
        self.tensors = tensors
        self.left = 2 * tensors + TEMPORARY
        self.generator = torch.Generator()

    def __torch_function__(
        self,
        function: Callable[..., Any],
        types: Any,
        arguments: tuple[Any, ...] = (),
        settings: dict[str, Any] | None = None,
    ) -> Any:
        """Call a function of torch."""
        settings = dict(settings or {})
        if _draws(function) and settings.get("generator") is None:
            settings["generator"] = self.generator
        result = function(*arguments, **settings)
        if isinstance(result, Tensor) and not _takes_tensors(arguments, settings):
            self._count()
        return result

    def _count(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise ValueError(f"it has more than the {self.tensors} tensors of the file.")


def _draws(function: Callable[..., Any]) -> bool:
    return getattr(function, "__name__", "") in RANDOM


def _takes_tensors(arguments: tuple[Any, ...], settings: dict[str, Any]) -> bool:
    return any(isinstance(value, Tensor) for value in (*arguments, *settings.values()))
