"""LZF streams."""

import pytest

from mops_lightning.data.formats.lzf import decompress


def test_decompress_literals_and_repeats_gives_the_bytes():
    literal = bytes([3]) + b"abcd"
    two_back = bytes([1 << 5, 1])  # three bytes from two bytes back: they overlap the new ones
    five_back = bytes([2 << 5, 4])
    long = bytes([7 << 5, 4, 0])  # 4 + 7 + 2 times the last byte

    stream = literal + two_back + five_back + long
    expected = b"abcdcdccdcd" + b"d" * 13

    result = decompress(stream, len(expected))

    assert result == expected


def test_decompress_far_repeat_counts_both_bytes_of_its_distance():
    start = bytes([31]) + bytes(range(32))
    run = bytes([7 << 5, 255, 31])  # 264 bytes, again and again the 32 before
    far = bytes([(1 << 5) + 1, 0x27])  # 0x127 + 1 = 296 bytes back: the beginning
    stream = start + run + far

    result = decompress(stream, 299)

    numbers = bytes(range(32))
    assert result[:288] == numbers * 9
    assert result[288:296] == numbers[:8]
    assert result[296:] == bytes([0, 1, 2])


ONE_LETTER = b"\x00a"
BROKEN = {
    "literal": (b"\x05abc", 6, "end early"),
    "distance": (ONE_LETTER + bytes([1 << 5]), 4, "end early"),
    "length": (ONE_LETTER + bytes([7 << 5]), 4, "end early"),
    "before the start": (ONE_LETTER + bytes([1 << 5, 1]), 4, "are broken"),
    "too short": (ONE_LETTER, 2, "are not 2 bytes"),
    "too long": (b"\x01ab", 1, "are not 1 bytes"),
}


@pytest.mark.parametrize(("stream", "size", "message"), BROKEN.values(), ids=BROKEN)
def test_decompress_broken_stream_is_refused(stream, size, message):
    with pytest.raises(ValueError, match=message):
        decompress(stream, size)


def test_decompress_stops_soon_after_the_declared_size():
    long_run = bytes([7 << 5, 255, 0])
    bomb = ONE_LETTER + long_run * 100_000

    with pytest.raises(ValueError, match="are not 10 bytes"):
        decompress(bomb, 10)
