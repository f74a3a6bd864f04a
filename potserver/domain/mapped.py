"""A file in memory whose pages the disk may fail to read back: that is noticed, and does not end the process.

The system tells it by the signal SIGBUS, to the thread that touches such a page. The handler here puts a page of zeros there,
notes whose it was, and the thread goes on; whoever computed something from the file asks it afterwards (`is_lost`). The handler
is compiled code, which needs neither the interpreter nor its lock. A SIGBUS anywhere else goes to whoever had it before, as
does every one on systems other than Linux.
"""

from __future__ import annotations

import ctypes
import functools
import mmap
import signal
import sys
import threading
import weakref
from typing import Any

import numba as nb
import numpy as np

from potserver.errors import StorageError
from potserver.numerics.simd import load_i64, store_i64

_MOST = 4096  # that may be mapped at once, of 256 MiB each
_START, _END, _IS_LOST = range(0, 24, 8)  # bytes in a record of the table
_RECORD = 24
_AT_ADDRESS = 16  # bytes before the address in siginfo_t

_lock = threading.Lock()
# The handler reads it: where each lies, and whether a page of it is lost.
_table = np.zeros((_MOST, _RECORD // 8), np.int64)
_free = list(range(_MOST))[::-1]


class _SigAction(ctypes.Structure):
    """`struct sigaction` of Linux."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_ulong * 16),
        ("flags", ctypes.c_int),
        ("restorer", ctypes.c_void_p),
    )


_SA_SIGINFO, _SA_NODEFER = 4, 0x40000000


class MappedFile:
    """A stretch of an open file, mapped for as long as this or an array in it lives."""

    def __init__(self, fd: int, n_bytes: int, offset: int) -> None:
        """Map it.

        Raises:
            OSError: the system refuses. StorageError: too many are mapped.
        """
        self.buffer = mmap.mmap(fd, n_bytes, offset=offset)
        _install()
        with _lock:
            if not _free:
                raise StorageError(f"{_MOST} stretches of files are mapped, the limit")
            self._record = _table[_free.pop()]
            start = np.frombuffer(self.buffer, np.uint8).ctypes.data
            self._record[:] = start, start + n_bytes, 0
        weakref.finalize(self.buffer, _forget, self._record).atexit = False

    def let_go(self) -> None:
        """Take it out of this process's memory; whoever reads there brings it back."""
        if hasattr(mmap, "MADV_DONTNEED"):
            self.buffer.madvise(mmap.MADV_DONTNEED)

    @property
    def is_lost(self) -> bool:
        """The disk did not read back a page that somebody touched: what was computed from here may be wrong, for ever."""
        return bool(self._record[_IS_LOST // 8])


def _forget(record: np.ndarray[Any, np.dtype[np.int64]]) -> None:
    with _lock:
        record[:] = 0
        _free.append((record.ctypes.data - _table.ctypes.data) // _RECORD)


@functools.cache
def _install() -> object:
    """Handle SIGBUS from now on; what must live as long as the process."""
    if sys.platform != "linux":
        return None
    libc = ctypes.CDLL(None)
    before = _SigAction()
    handler = _compiled(libc, ctypes.addressof(before))
    ours = _SigAction(handler=handler.address, flags=_SA_SIGINFO | _SA_NODEFER)
    if libc.sigaction(int(signal.SIGBUS), ctypes.addressof(ours), ctypes.addressof(before)):
        raise OSError("sigaction refuses SIGBUS")
    return handler, before


def _compiled(libc: ctypes.CDLL, before: int) -> Any:
    """The handler, which knows these addresses: no cache may keep it."""
    table, page, number = _table.ctypes.data, mmap.PAGESIZE, int(signal.SIGBUS)
    protection, flags = (
        mmap.PROT_READ | mmap.PROT_WRITE,
        mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x10,
    )  # MAP_FIXED
    long = ctypes.c_int64
    map_page = libc.mmap
    map_page.argtypes, map_page.restype = (long, long, ctypes.c_int, ctypes.c_int, ctypes.c_int, long), long
    give_back = libc.sigaction
    give_back.argtypes, give_back.restype = (ctypes.c_int, long, long), ctypes.c_int

    @nb.cfunc("void(int32, int64, int64)", nopython=True, error_model="numpy")
    def handle(_number: int, info: int, _context: int) -> None:
        address = load_i64(info + _AT_ADDRESS)
        for i in range(_MOST):
            record = table + i * _RECORD
            if load_i64(record + _START) <= address < load_i64(record + _END):
                store_i64(record + _IS_LOST, 1)
                if map_page(address // page * page, page, protection, flags, -1, 0) != -1:
                    return
        give_back(number, before, 0)  # the instruction that failed fails again, before another handler

    return handle
