"""The digest of a run record, by which ``report`` finds records that were edited after the run."""

import hashlib
import json
from typing import Any

NOT_COVERED = ("digest", "folder", "files")
"""Fields that may change after the run: where the record and the run's files are."""


def digest_of(plain: dict[str, Any]) -> str:
    """Return the sha256 of a record's content.

    Empty fields do not count, so that a later version with further fields gives the same digest.

    Args:
        plain: the record as plain data, with None for NaN and infinity.
    """
    content = {}
    for name, value in plain.items():
        if name not in NOT_COVERED and not _is_empty(value):
            content[name] = value
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()


def _is_empty(value: Any) -> bool:
    if isinstance(value, str | list | dict):
        return not value
    return value is None or value is False
