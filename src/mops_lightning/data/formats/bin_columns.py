"""Names of the columns of .bin files, which have no header, as a user gives them."""

from collections.abc import Sequence

from mops_lightning.errors import UserError


def parse_columns(text: str) -> tuple[str, ...]:
    """Return the names of columns that a user gave, separated by commas.

    Raises:
        UserError: a name is missing or there twice.
    """
    names = [name.strip() for name in text.split(",")]
    return check_columns("--columns", names)


def check_columns(setting: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the columns of .bin files.

    Args:
        setting: how the user gives them, for errors.
        names: of all columns, in order.

    Raises:
        UserError: a name is missing or there twice.
    """
    is_list = not isinstance(names, str) and all(isinstance(name, str) for name in names)
    is_complete = is_list and {"x", "y", "z"} <= set(names) and "" not in names
    is_each_once = len(set(names)) == len(names)
    if not is_complete or not is_each_once:
        got = names
        if not isinstance(names, str):
            got = ",".join(map(str, names))
        raise UserError(
            f"{setting} must name all columns of a .bin file, each once, with x, y and z among "
            f"them, such as x,y,z,intensity,ring; got {got!r}."
        )
    return tuple(names)
