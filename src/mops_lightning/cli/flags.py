"""Hydra's flags, such as ``--multirun``: allowed before, between and after the settings."""

import argparse

from mops_lightning.errors import UserError, did_you_mean


def flags_first(arguments: list[str]) -> list[str]:
    """Move Hydra's flags before the settings, because Hydra wants all settings in one place.

    Args:
        arguments: of the command line, such as ``["m=8", "--cfg", "job", "sampler=fps"]``.

    Returns:
        The same arguments; flags with their values and settings keep their order.

    Raises:
        UserError: there is no such flag, flags exclude each other, or a flag's value is missing
            or not allowed.
    """
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()
    parser.exit_on_error = False
    parser.allow_abbrev = False  # an ambiguous abbreviation exits in any case
    try:
        read, unknown = parser.parse_known_intermixed_args(arguments)
    except argparse.ArgumentError as error:
        raise UserError(f"{error.argument_name}: {error.message}.") from None
    known = [action.option_strings[0] for action in parser._actions if action.option_strings]
    for flag in unknown:
        hint = did_you_mean(flag.split("=")[0], known)
        raise UserError(f"no flag {flag!r}.{hint} Settings are KEY=VALUE, without dashes.")
    _check_combination(read)
    flags = list(arguments)
    for setting in read.overrides:
        flags.remove(setting)
    return [*flags, *read.overrides]


def _check_combination(read: argparse.Namespace) -> None:
    actions = ("run", "multirun", "cfg", "info", "shell_completion")
    chosen = [f"--{name.replace('_', '-')}" for name in actions if getattr(read, name)]
    if len(chosen) > 1 and not (read.help or read.hydra_help):
        raise UserError(f"{' and '.join(chosen)}: give one of them. `--cfg job` shows one run.")
    if read.resolve and not (read.cfg or read.help):
        raise UserError("--resolve belongs to --cfg: write --cfg job --resolve.")
    if read.experimental_rerun:
        raise UserError(
            "--experimental-rerun is not available, because the pickle that it reads can run code. "
            "Repeat the run with the overrides in its result.json."
        )
