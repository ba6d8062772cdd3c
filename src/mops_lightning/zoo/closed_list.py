"""Building a module that a file describes, from a list of classes; the file imports nothing."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from mops_lightning.config.annotations import misfit
from mops_lightning.errors import UserError
from mops_lightning.zoo.weights import check_shapes, fit_state


@dataclass(frozen=True)
class ClosedList:
    """The classes that files may name.

    Attributes:
        classes: a file's ``_target_`` is compared with their names.
        where: the place of the description in a file's configuration.
        what: the kind of module, for errors.
        hint: what to do with any other class, for errors.
    """

    classes: tuple[type[nn.Module], ...]
    where: str
    what: str
    hint: str

    def build(
        self, node: Any, state: dict[str, Tensor], path: str | Path, hint: str, **offered: Any
    ) -> Any:
        """Build the module that a file describes; torch's random state stays as it is.

        Args:
            node: the class's name under ``_target_``, and its arguments.
            state: the file's tensors by name.
            path: the file, for errors.
            hint: what to try next if the tensors are not the module's, for errors.
            **offered: further arguments, for classes that take them.

        Returns:
            The module with these tensors.

        Raises:
            UserError: the class is not in the list, an argument is not plain or not the class's, or
                the tensors do not match the module.
        """
        node = node or {}
        if not isinstance(node, dict) or not all(isinstance(name, str) for name in node):
            raise UserError(
                f"{path}: its setting {self.where} must be a group of settings, got {node!r:.99}."
            )
        arguments = dict(node)
        target = arguments.pop("_target_", None)
        known = {f"{cls.__module__}.{cls.__qualname__}": cls for cls in self.classes}
        if not isinstance(target, str) or target not in known:
            raise UserError(
                f"{path}: {self.where}._target_ must be a {self.what} of mops_lightning, got "
                f"{target!r}. {self.hint}"
            )
        parameters = signature(known[target]).parameters
        for name, value in arguments.items():
            if not _is_plain(value):
                raise UserError(
                    f"{path}: {self.where}.{name} must be a number, a string, a list of them or "
                    f"null, got {type(value).__name__}."
                )
            wanted = misfit(value, parameters[name].annotation) if name in parameters else None
            if wanted:
                raise UserError(f"{path}: {self.where}.{name} must be {wanted}, got {value!r:.99}.")
        arguments |= {name: value for name, value in offered.items() if name in parameters}
        make = partial(_built, known[target], arguments, path)
        with torch.random.fork_rng(devices=[]):  # the initial weights are replaced at once
            # Without memory first: a small file can describe a large net.
            with torch.device("meta"), at_most(len(state)):
                check_shapes(make(), state, path, hint)
            module = make()
        fit_state(module, state, path, hint)
        return module


def _built(cls: type[nn.Module], arguments: dict[str, Any], path: str | Path) -> nn.Module:
    try:
        return cls(**arguments)
    except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: sizes beyond 64 bits
        reason = str(error).partition("\n")[0]
        name = f"{cls.__module__}.{cls.__qualname__}"
        raise UserError(f"{path}: cannot build {name}: {reason}") from None


@contextmanager
def at_most(number: int) -> Iterator[None]:
    """Limit the number of parameters of the modules that are built.

    Raises:
        ValueError: there are more.
    """
    left = number

    def count(*_: Any) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise ValueError(f"it has more than the {number} tensors of the file.")

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def _is_plain(value: Any) -> bool:
    if isinstance(value, list):
        return all(item is not None and _is_plain(item) for item in value)
    return value is None or isinstance(value, bool | int | float | str)
