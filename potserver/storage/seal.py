"""Bytes with a checksum behind them: what tells a damaged record from a sound one. It is not a signature."""

from __future__ import annotations

import hashlib

SEAL_BYTES = 16


def sealed(content: bytes, *, place: bytes = b"") -> bytes:
    """The content and its BLAKE2b digest.

    Args:
        content: What is kept.
        place: Where it is kept, as far as that is part of it: it goes into the digest and not into the result.
    """
    return content + _digest(place, content)


def unsealed(data: object, *, place: bytes = b"") -> bytes | None:
    """The content of what `sealed` made; None where it is damaged, is no bytes, or is of another place."""
    if not isinstance(data, bytes) or data[-SEAL_BYTES:] != _digest(place, data[:-SEAL_BYTES]):
        return None
    return data[:-SEAL_BYTES]


def seal_number(data: bytes) -> int:
    """The digest in what `sealed` made, as a number below 2 ** (8 * SEAL_BYTES)."""
    return int.from_bytes(data[-SEAL_BYTES:], "little")


def _digest(place: bytes, content: bytes) -> bytes:
    state = hashlib.blake2b(place, digest_size=SEAL_BYTES)
    state.update(content)
    return state.digest()
