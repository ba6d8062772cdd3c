"""Names of the columns of .bin files, which have no header, as a user gives them."""

from mops_lightning.errors import UserError


def parse_columns(text: str) -> tuple[str, ...]:
    """Return the names of columns that a user gave, separated by commas.

    Raises:
        UserError: a name is missing or there twice.
    """
    names = tuple(name.strip() for name in text.split(","))
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names) or "" in names:
        raise UserError(
            f"--columns must name all columns of a .bin file, each once, with x, y and z among "
            f"them, such as x,y,z,intensity,ring; got {text!r}."
        )
    return names
