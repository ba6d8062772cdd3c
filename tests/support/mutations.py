"""Damaged and crafted forms of files, made from good ones."""

import io
import re
import zipfile

import numpy as np

NUMBERS = (0, 1, -1, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
WORDS = (b"0", b"-1", b"nan", b"inf", b"1e999", b"", b"x", b"4294967295", b"99999999999", b"1e-320",
         b"9" * 30, b"9" * 5000)  # fmt: skip


def mutated(random, content, others):
    """Return ``content`` with one to three changes; ``others`` are files of the same kind."""
    unpacked = unpack(content)
    if unpacked is not None and random.random() < 0.7:
        names = list(unpacked)
        if not names:
            return content
        name = names[random.integers(len(names))]
        unpacked[name] = plainly_mutated(random, unpacked[name], list(unpacked.values()))
        return pack(content, unpacked)
    return plainly_mutated(random, content, others)


def plainly_mutated(random, content, others):
    for _ in range(random.integers(1, 4)):
        change = CHANGES[random.integers(len(CHANGES))]
        content = change(random, bytearray(content), others)
    return bytes(content)


def place(random, content):
    """Return a place, half of the time in the first part, where headers are."""
    end = len(content) if random.random() < 0.5 else min(len(content), 400)
    return int(random.integers(max(end, 1)))


def flip_bits(random, content, others):
    for _ in range(random.integers(1, 9) if content else 0):
        content[place(random, content)] ^= 1 << random.integers(8)
    return content


def truncate(random, content, others):
    return content[: place(random, content)]


def insert(random, content, others):
    at = place(random, content)
    return content[:at] + random.bytes(random.integers(1, 64)) + content[at:]


def delete(random, content, others):
    at = place(random, content)
    return content[:at] + content[at + int(random.integers(1, 64)) :]


def repeat(random, content, others):
    at = place(random, content)
    length = int(random.integers(1, 400))
    return content[:at] + content[at : at + length] * int(random.integers(2, 9)) + content[at:]


def change_binary_number(random, content, others):
    at = place(random, content)
    size = int(random.choice([1, 2, 4, 8]))
    number = NUMBERS[random.integers(len(NUMBERS))] % (1 << 8 * size)
    content[at : at + size] = number.to_bytes(size, random.choice(["little", "big"]))
    return content


def change_written_number(random, content, others):
    found = list(re.finditer(rb"-?\d+(\.\d+)?", content[:4000]))
    if not found:
        return change_binary_number(random, content, others)
    chosen = found[random.integers(len(found))]
    word = WORDS[random.integers(len(WORDS))]
    return content[: chosen.start()] + word + content[chosen.end() :]


def splice(random, content, others):
    other = others[random.integers(len(others))]
    return content[: place(random, content)] + other[place(random, other) :]


CHANGES = (flip_bits, truncate, insert, delete, repeat, change_binary_number,
           change_written_number, change_written_number, splice)  # fmt: skip


def unpack(content):
    """Return the members of a zip file, None for anything else."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            return {name: file.read(name) for name in file.namelist()}
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
