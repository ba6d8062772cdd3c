"""Damaged and crafted forms of files, made from good ones."""

import io
import re
import zipfile

import numpy as np

NUMBERS = (
    0,
    1,
    -1,
    2**15,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
"""Binary numbers at the limits of types."""

WORDS = (
    b"0",
    b"-1",
    b"nan",
    b"inf",
    b"1e999",
    b"",
    b"x",
    b"4294967295",
    b"99999999999",
    b"1e-320",
    b"9" * 30,
    b"9" * 5000,
)
"""Written numbers that parsers may not expect."""

HEADER = 400
"""Bytes at the beginning of a file that are changed more often."""


def mutated(random, content, others):
    """Return ``content`` with one to three changes; ``others`` are files of the same kind."""
    members = unpack(content)
    changes_a_member = members is not None and random.random() < 0.7
    if not changes_a_member:
        return plainly_mutated(random, content, others)
    if not members:
        return content
    name = any_of(random, list(members))
    other_members = list(members.values())
    members[name] = plainly_mutated(random, members[name], other_members)
    return pack(content, members)


def plainly_mutated(random, content, others):
    """Return ``content`` with one to three changes."""
    number = random.integers(1, 4)
    for _ in range(number):
        change = any_of(random, CHANGES)
        content = change(random, bytearray(content), others)
    return bytes(content)


def any_of(random, values):
    """Return one of several values."""
    return values[random.integers(len(values))]


def place(random, content):
    """Return a place, half of the time in the first part, where headers are."""
    end = len(content)
    is_anywhere = random.random() < 0.5
    if not is_anywhere:
        end = min(end, HEADER)
    return int(random.integers(max(end, 1)))


def flip_bits(random, content, others):
    if not content:
        return content
    number = random.integers(1, 9)
    for _ in range(number):
        at = place(random, content)
        content[at] ^= 1 << random.integers(8)
    return content


def truncate(random, content, others):
    return content[: place(random, content)]


def insert(random, content, others):
    start = place(random, content)
    length = random.integers(1, 64)
    return content[:start] + random.bytes(length) + content[start:]


def delete(random, content, others):
    start = place(random, content)
    end = start + int(random.integers(1, 64))
    return content[:start] + content[end:]


def repeat(random, content, others):
    start = place(random, content)
    end = start + int(random.integers(1, 400))
    times = int(random.integers(2, 9))
    return content[:start] + content[start:end] * times + content[start:]


def change_binary_number(random, content, others):
    start = place(random, content)
    size = int(random.choice([1, 2, 4, 8]))
    number = any_of(random, NUMBERS) % 2 ** (8 * size)
    order = random.choice(["little", "big"])
    content[start : start + size] = number.to_bytes(size, order)
    return content


def change_written_number(random, content, others):
    beginning = content[:4000]
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", beginning))
    if not numbers:
        return change_binary_number(random, content, others)
    number = any_of(random, numbers)
    word = any_of(random, WORDS)
    return content[: number.start()] + word + content[number.end() :]


def splice(random, content, others):
    other = any_of(random, others)
    end = place(random, content)
    start = place(random, other)
    return content[:end] + other[start:]


CHANGES = (
    flip_bits,
    truncate,
    insert,
    delete,
    repeat,
    change_binary_number,
    change_written_number,
    change_written_number,  # twice as often
    splice,
)


def unpack(content):
    """Return the members of a zip file, None for anything else."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            members = {}
            for name in file.namelist():
                members[name] = file.read(name)
            return members
    except (OSError, EOFError, zipfile.BadZipFile):
        return None


def pack(content, members):
    """Pack members as ``content`` is packed, with correct checksums."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(packed, "w") as new:
        for info in old.infolist():
            new.writestr(info.filename, members[info.filename], info.compress_type)
    return packed.getvalue()


def generator(kind, number):
    """Return the random numbers of one file: the same in every run."""
    return np.random.default_rng([*kind.encode(), number])
