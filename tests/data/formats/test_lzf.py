"""LZF streams."""

import pytest

from mops_lightning.data.formats.lzf import decompress


def test_decompress_literals_and_repeats_gives_the_bytes():
    literal = bytes([3]) + b"abcd"
    two_back = bytes([1 << 5, 1])  # three bytes from two bytes back: they overlap the new ones
    five_back = bytes([2 << 5, 4])
    long = bytes([7 << 5, 4, 0])  # 4 + 7 + 2 times the last byte

    result = decompress(literal + two_back + five_back + long, 4 + 3 + 4 + 13)

    assert result == b"abcd" + b"cdc" + b"cdcd" + b"d" * 13


def test_decompress_far_repeat_counts_both_bytes_of_its_distance():
    start = bytes([31]) + bytes(range(32))
    run = bytes([7 << 5, 255, 31])  # 264 bytes, again and again the 32 before
    far = bytes([(1 << 5) + 1, 0x27])  # 0x127 + 1 = 296 bytes back: the beginning

    result = decompress(start + run + far, 32 + 264 + 3)

    assert result == bytes(range(32)) * 9 + bytes(range(8)) + bytes([0, 1, 2])


@pytest.mark.parametrize(
    ("stream", "size", "message"),
    [
        pytest.param(bytes([5]) + b"abc", 6, "end early", id="literal"),
        pytest.param(bytes([0]) + b"a" + bytes([1 << 5]), 4, "end early", id="distance"),
        pytest.param(bytes([0]) + b"a" + bytes([7 << 5]), 4, "end early", id="length"),
        pytest.param(
            bytes([0]) + b"a" + bytes([1 << 5, 1]), 4, "are broken", id="before the start"
        ),
        pytest.param(bytes([0]) + b"a", 2, "are not 2 bytes", id="too short"),
        pytest.param(bytes([1]) + b"ab", 1, "are not 1 bytes", id="too long"),
    ],
)
def test_decompress_broken_stream_is_refused(stream, size, message):
    with pytest.raises(ValueError, match=message):
        decompress(stream, size)


def test_decompress_stops_soon_after_the_declared_size():
    bomb = bytes([0]) + b"a" + bytes([7 << 5, 255, 0]) * 100_000

    with pytest.raises(ValueError, match="are not 10 bytes"):
        decompress(bomb, 10)
