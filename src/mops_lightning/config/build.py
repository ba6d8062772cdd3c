"""Turning configuration nodes into objects: the only place that calls Hydra's instantiate."""

import inspect
import logging
import re
from collections.abc import Callable, Mapping
from functools import update_wrapper
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.errors import UserError

# It logs as an error what it also raises.
logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)

Parameters = dict[str, inspect.Parameter]
"""Parameters of a function by name."""

REJECTIONS = (ValueError, TypeError, OverflowError, ZeroDivisionError)
"""Errors that constructors of other libraries raise for invalid settings."""

WRITER = "torch.utils.tensorboard.SummaryWriter"

PASSED_ON = {
    "lightning.pytorch.loggers.TensorBoardLogger": WRITER,
    "mops_lightning.training.run.board.Board": WRITER,
}
"""Classes that pass further settings on to others, which refuse them after pretraining."""


def build(node: Any, where: str = "", **extra: Any) -> Any:
    """Make the object that a node describes, with the objects of the nodes below it.

    Constructors name their arguments in errors (``tau_min must be ...``), for they know nothing of
    settings. Where such an error starts with an argument that the node sets, the setting takes its
    place: ``sampler.tau_min must be ...`` for ``where="sampler"``, and ``m must be ...`` for an
    argument that the node takes from the setting ``m`` (``m: ${m}``). The same holds for errors
    from later calls of a ``_partial_`` function. Any other error is passed on unchanged.

    Args:
        node: a configuration with ``_target_``.
        where: the dotted path of the node in the configuration.
        **extra: further arguments of the constructor, which no YAML could know.

    Raises:
        UserError: the constructor rejects an argument, or the target needs a package that is not
            installed.
    """
    from hydra.errors import InstantiationException
    from hydra.utils import instantiate

    below = _built_below(node, where, extra)
    try:
        built = instantiate(node, **below, **extra, _convert_="all")
    except (InstantiationException, *REJECTIONS) as error:
        if isinstance(error, UserError):
            raise
        known = _known_cause(error, node, where)
        if known is None:
            raise
        raise _with_path(known, _unresolved(node), where, tuple(extra)) from None
    if isinstance(node, DictConfig) and node.get("_partial_"):
        return Deferred(built, _unresolved(node), where)
    return built


def _built_below(node: Any, where: str, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return the objects that the nodes below a node describe, except those that code gives."""
    built: dict[str, Any] = {}
    if not isinstance(node, DictConfig):
        return built
    for key in node:
        name = str(key)
        if name in extra or OmegaConf.is_missing(node, key):
            continue
        child = node[key]
        if isinstance(child, DictConfig) and "_target_" in child:
            path = f"{where}.{name}" if where else name
            built[name] = build(child, path)
    return built


class Deferred:
    """A target that is called later, with the settings of its node and further arguments.

    Its signature is the target's: callers read there whether it takes ``m`` or ``m_max``.

    Args:
        function: calls the target with the settings.
        node: the settings, unresolved.
        where: the dotted path of the node in the configuration.
    """

    def __init__(self, function: Callable[..., Any], node: dict[str, Any], where: str) -> None:
        update_wrapper(self, function)
        self._function = function
        self._node = node
        self._where = where

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the target.

        Raises:
            UserError: it rejects an argument; the error names the setting.
        """
        try:
            return self._function(*args, **kwargs)
        except UserError as error:
            parameters = list(signature(str(self._node["_target_"]), self._where))
            positional = parameters[: len(args)]
            extra = (*positional, *kwargs)
            raise _with_path(error, self._node, self._where, extra) from error.__cause__
        except REJECTIONS as error:
            raise _rejected(error, self._node, self._where) from error

    def __deepcopy__(self, memo: dict[int, Any]) -> "Deferred":
        """Return itself: it never changes, and what hydra-core 1.4 calls cannot be copied.

        Lightning copies a module with all that it holds for a moving average of its weights.
        """
        return self


def build_as(
    kind: type,
    node: DictConfig,
    where: str,
    offered: Mapping[str, Any] | None = None,
    **extra: Any,
) -> Any:
    """Make the object that a node describes, which must be of a class; see ``build``.

    Args:
        kind: the class.
        node: a configuration with ``_target_``.
        where: the dotted path of the node in the configuration.
        offered: further arguments by name, of which the constructor is given those that it takes.
        **extra: further arguments of the constructor.

    Raises:
        UserError: also if it is of another class.
    """
    taken = {}
    if offered:
        parameters = signature(str(node["_target_"]), where)
        for name, value in offered.items():
            if name in parameters:
                taken[name] = value
    built = build(node, where, **taken, **extra)
    if not isinstance(built, kind):
        raise UserError(
            f"{where}: {node.get('_target_')} must return a {kind.__name__}, got "
            f"{type(built).__name__}."
        )
    return built


def _known_cause(error: BaseException, node: Any, where: str) -> UserError | None:
    """Return the user's mistake behind an error of Hydra's, if it is one."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, UserError):
            return cause
        if isinstance(cause, ModuleNotFoundError):
            target = node.get("_target_", node)
            return UserError(f"{target} needs a package that is not installed: {cause}")
        if type(cause).__name__ == "MisconfigurationException":
            return _refused_by_lightning(cause, where)
        if isinstance(cause, REJECTIONS) and cause.__cause__ is None:
            return _rejected(cause, node, where)
        cause = cause.__cause__
    return None


def _refused_by_lightning(cause: BaseException, where: str) -> UserError:
    """Return Lightning's refusal in one line, such as of a trainer that this machine cannot run."""
    text = " ".join(str(cause).split())
    is_about_machine = any(word in text.lower() for word in ("accelerator", "gpu", "device"))
    if is_about_machine:
        text += " Try trainer=auto or trainer=cpu."
    return UserError(f"{where}: {text}")


def _rejected(cause: Exception, node: Any, where: str) -> UserError:
    """Return the error about a value that a constructor of another library rejects."""
    target = node.get("_target_", node)
    text = " ".join(str(cause).split())[:300].rstrip(".")
    return UserError(f"{where}: {target} does not take these settings: {text}.")


def _unresolved(node: Any) -> dict[str, Any]:
    """Return a node as a plain dict, with its interpolations as they are written."""
    plain: Any = OmegaConf.to_container(node, resolve=False)
    return dict(plain)


def _with_path(
    error: UserError, node: dict[str, Any], where: str, extra: tuple[str, ...]
) -> UserError:
    """Put the setting's path in place of the argument that an error starts with.

    Args:
        error: as the constructor raised it.
        node: the configuration of the object, unresolved.
        where: the dotted path of this configuration.
        extra: arguments that code gave, not the configuration.
    """
    text = str(error)
    argument = re.match(r"([A-Za-z_]\w*)(?![\w.])", text)
    if argument is None or not where:
        return error
    name = argument.group(1)
    is_from_code = name in extra and name not in node
    if is_from_code or name not in signature(str(node["_target_"]), where):
        return error
    setting = f"{where}.{name}"
    shared = re.fullmatch(r"\$\{(\w+)\}", str(node.get(name)))
    if shared:
        setting = shared.group(1)
    return UserError(setting + text[len(name) :])


def takes(node: DictConfig, name: str) -> bool:
    """Return whether a node's constructor has an argument of this name."""
    return name in signature(str(node["_target_"]), "")


def signature(target: str, where: str) -> Parameters:
    """Return the parameters of a target, with those that a class passes on to its bases.

    Raises:
        UserError: the target cannot be imported, or cannot be called.
    """
    from hydra.utils import get_object

    try:
        called = get_object(target)
    except Exception as error:
        # The last line says what failed; Hydra puts others before and after it.
        reason = str(error.__cause__ or error).strip().splitlines()[-1]
        raise UserError(f"{where}._target_: cannot import {target!r}: {reason}") from None
    if not callable(called):
        raise UserError(f"{where}._target_: {target!r} is neither a class nor a function.")
    if not inspect.isclass(called):
        return _own_signature(called)
    parameters: Parameters = {}
    for cls in called.__mro__:
        if "__init__" not in vars(cls):
            continue
        taken = _own_signature(vars(cls)["__init__"])
        taken.pop("self", None)
        named = _without_keywords(taken)
        if parameters:  # what a base must be given, the class above gives it
            named = _optional(named)
        parameters = {**named, **parameters}
        passes_on = any(takes_keywords(parameter) for parameter in taken.values())
        if not passes_on:
            return parameters
    if target in PASSED_ON:
        return {**signature(PASSED_ON[target], where), **parameters}
    return {**parameters, **taken}  # the target takes any further argument


def takes_keywords(parameter: inspect.Parameter) -> bool:
    """Return whether a parameter is ``**kwargs``, such as a class passes on to its bases."""
    return parameter.kind is parameter.VAR_KEYWORD


def _without_keywords(parameters: Parameters) -> Parameters:
    kept = {}
    for name, parameter in parameters.items():
        if not takes_keywords(parameter):
            kept[name] = parameter
    return kept


def _optional(parameters: Parameters) -> Parameters:
    """Return the parameters that have a default."""
    kept = {}
    for name, parameter in parameters.items():
        if parameter.default is not parameter.empty:
            kept[name] = parameter
    return kept


def _own_signature(function: Any) -> Parameters:
    try:
        return dict(inspect.signature(function, eval_str=True).parameters)
    except NameError:  # an annotation that exists for type checkers only
        return dict(inspect.signature(function).parameters)
