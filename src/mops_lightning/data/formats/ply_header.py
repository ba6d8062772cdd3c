"""Headers of PLY files, with any encoding of comments and any line ends."""

import re

LONGEST = 1 << 20
"""Most bytes of a header; a file that exceeds it is not PLY."""


def split(data: bytes) -> tuple[list[str], int] | None:
    """Return the lines of a header, and where it ends in bytes; None if it does not end.

    Args:
        data: the first bytes of a file, at least ``LONGEST`` if it has as many.
    """
    first = re.match(rb"[^\r\n]*(\r?\n|\r)", data)
    if not first:
        return None
    end = b"\r" if first[1] == b"\r" else b"\n"
    last = re.compile(end + rb"[ \t]*end_header[ \t\r]*?" + end).search(data, 0, LONGEST)
    if not last:
        return None
    lines = data[: last.start()].decode("latin-1").split(end.decode())
    return [line.strip() for line in lines], last.end()


def plain(data: bytes) -> bytes:
    """Return a PLY file with a header that trimesh reads: no comments, lines that end in LF.

    A comment may name a texture, which would be a path to any file.

    Raises:
        ValueError: the header does not end.
    """
    found = split(data)
    if found is None:
        raise ValueError("its header does not end")
    lines = [line for line in found[0] if line.split()[:1] not in ([], ["comment"], ["obj_info"])]
    return "\n".join([*lines, "end_header\n"]).encode() + data[found[1] :]
