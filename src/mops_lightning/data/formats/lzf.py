"""Decompression of LZF, the format of Marc Lehmann's liblzf, which PCD files use."""


def decompress(data: bytes, size: int) -> bytes:
    """Decompress data to ``size`` bytes.

    Raises:
        ValueError: the data are damaged, or decompress to another number of bytes.
    """
    out = bytearray()
    place = 0
    while place < len(data) and len(out) <= size:
        control = data[place]
        place += 1
        if control < 32:  # control + 1 literal bytes
            out += data[place : place + control + 1]
            place += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[place]
            place += 1
        start = len(out) - ((control & 31) << 8) - data[place] - 1
        place += 1
        length += 2
        if start < 0:
            raise ValueError("compressed data refer to bytes before their start")
        piece = bytes(out[start : start + length])
        if len(piece) < length:  # the source overlaps the bytes that the copy appends
            piece = (piece * (length // max(len(piece), 1) + 1))[:length]
        out += piece
    if len(out) != size:
        raise ValueError(f"compressed data give {len(out)} bytes, expected {size}")
    return bytes(out)
