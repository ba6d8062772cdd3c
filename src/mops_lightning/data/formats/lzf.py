"""LZF, the compression of PCD files with ``DATA binary_compressed``."""

LONGEST_LITERAL = 32
"""A first byte below this is the length, less one, of bytes that follow as they are."""


def decompress(data: bytes, size: int) -> bytes:
    """Return the ``size`` bytes of a stream that libLZF or PCL compressed.

    Memory grows with what the stream holds, at most 88 bytes for one of ``data``, and never by
    ``size`` alone.

    Raises:
        ValueError: the stream ends early, points before its beginning, or has another size.
    """
    result = bytearray()
    place = 0
    while place < len(data) and len(result) <= size:
        first = data[place]
        place += 1
        if first < LONGEST_LITERAL:
            end = place + first + 1
            result += data[place:end]
            place = end
            continue
        length = first >> 5
        if length == 7:
            length += _byte(data, place)
            place += 1
        distance = ((first & 31) << 8) + _byte(data, place) + 1
        place += 1
        _repeat(result, distance, length + 2)
    if place > len(data):
        raise ValueError("its compressed points end early")
    if len(result) != size:
        raise ValueError(f"its compressed points are not {size} bytes")
    return bytes(result)


def _byte(data: bytes, place: int) -> int:
    if place >= len(data):
        raise ValueError("its compressed points end early")
    return data[place]


def _repeat(result: bytearray, distance: int, length: int) -> None:
    """Append ``length`` bytes from ``distance`` bytes back; they may be among those appended."""
    start = len(result) - distance
    if start < 0:
        raise ValueError("its compressed points are broken")
    if distance >= length:
        result += result[start : start + length]
        return
    pattern = result[start:]
    whole, rest = divmod(length, distance)
    result += pattern * whole + pattern[:rest]
