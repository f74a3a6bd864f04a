"""The C library's allocator, told to give memory back. A map is many small arrays that live long among large ones that do not.

Left alone, glibc keeps a heap for each thread and every hole in them: a map of 34 MB held 116. And what a scan works in goes
back to the system page by page, which clears 4,000 new pages for the next one. On other C libraries this does nothing.
"""

from __future__ import annotations

import ctypes
from functools import cache

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # of glibc's malloc.h
_KEPT_BYTES = 256 * 2**20  # free at the end of the heap, at most
_APART_BYTES = 32 * 2**20  # of an array that is no part of the heap


def use_one_heap() -> None:
    """Let all threads of this process share one heap, which keeps what it has until `give_back`.

    To be called before there are any threads, and by programs only.
    """
    libc = _glibc()
    if libc is not None:
        libc.mallopt(_M_ARENA_MAX, 1)
        libc.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
        libc.mallopt(_M_MMAP_THRESHOLD, _APART_BYTES)


def give_back() -> None:
    """Give the holes in the heaps back to the system; takes some milliseconds."""
    libc = _glibc()
    if libc is not None:
        libc.malloc_trim(0)


@cache
def _glibc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL(None)
        return libc if hasattr(libc, "gnu_get_libc_version") else None
    except (OSError, TypeError):  # no C library that can be looked into
        return None
