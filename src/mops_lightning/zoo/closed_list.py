"""Building a module that a file describes, from a list of classes; the file imports nothing."""

from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from torch import nn

from mops_lightning.config.annotations import misfit
from mops_lightning.errors import UserError


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

    def build(self, node: Any, path: str | Path, **offered: Any) -> Any:
        """Build the untrained module that a file describes; torch's random state stays as it is.

        Args:
            node: the class's name under ``_target_``, and its arguments.
            path: the file, for errors.
            **offered: further arguments, for classes that take them.

        Raises:
            UserError: the class is not in the list, or an argument is not plain or not the class's.
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
                raise UserError(f"{path}: {self.where}.{name} must be {wanted}, got {value!r}.")
        given = {name: value for name, value in offered.items() if name in parameters}
        try:
            with torch.random.fork_rng(devices=[]):  # the initial weights are replaced at once
                return known[target](**{**arguments, **given})
        except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: beyond memory
            reason = str(error).partition("\n")[0]
            raise UserError(f"{path}: cannot build {target}: {reason}") from None


def _is_plain(value: Any) -> bool:
    if isinstance(value, list):
        return all(item is not None and _is_plain(item) for item in value)
    return value is None or isinstance(value, bool | int | float | str)
