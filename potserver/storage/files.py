"""The files of a store as the disk has them: made for their owner alone, never reached through a link, and still there."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from potserver.domain.folders import sync_folder
from potserver.errors import MapFileError, StorageError

_FOLDER_MODE, _FILE_MODE = 0o700, 0o600
_REASONS = {
    errno.EROFS: "read_only",
    errno.EACCES: "permission",
    errno.EPERM: "permission",
    errno.ENOSPC: "full",
    errno.EDQUOT: "full",
}


def disk_fault(doing: str, path: Path, detail: object, reason: str) -> StorageError:
    """What the disk refuses is not the map's fault, and the error says so.

    Args:
        doing: What was tried, e.g. `write`.
        path: Where.
        detail: What the system said.
        reason: `read_only`, `permission`, `full` or `io`.
    """
    return StorageError(
        f"cannot {doing} {path}: {detail}. That is the disk's doing, nothing is wrong with the map: free some space or make it"
        " writable, name another store (--store), serve what it holds with --read-only, or keep maps in memory (--in-memory)",
        reason=reason,
    )


@contextlib.contextmanager
def disk_faults(doing: str, path: Path) -> Iterator[None]:
    """An OSError inside the block becomes a `disk_fault`."""
    try:
        yield
    except OSError as error:
        reason = _REASONS.get(error.errno or 0, "io")
        raise disk_fault(doing, path, error.strerror or error, reason) from error


def make_private_folder(folder: Path) -> None:
    """Make a folder that only its owner may enter; one that is there stays as it is.

    Raises:
        StorageError: the disk refuses.
    """
    with disk_faults("make the folder", folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=_FOLDER_MODE)
        if not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))


def claim_file(path: Path) -> None:
    """Make a file that only its owner may read, or see that the one that is there is a file and no link to one.

    Raises:
        MapFileError: it is a link, a folder or a device. StorageError: the disk refuses.
    """
    with disk_faults("open", path):
        try:
            mode = os.lstat(path).st_mode
        except FileNotFoundError:
            descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, _FILE_MODE)
            try:
                os.fsync(descriptor)  # its name is there before that of a log beside it
            finally:
                os.close(descriptor)
            sync_folder(path.parent)
            return
        if not os.access(path, os.W_OK):  # SQLite would call it an I/O error
            is_read_only = bool(os.statvfs(path).f_flag & os.ST_RDONLY)
            number = errno.EROFS if is_read_only else errno.EACCES
            raise OSError(number, os.strerror(number))
    _check_regular(path, mode)


def check_no_link(path: Path) -> None:
    """See that a file that is there or not, and that somebody else will open, is a file.

    Raises:
        MapFileError: it is a link, a folder or a device. StorageError: the disk refuses.
    """
    with disk_faults("look at", path), contextlib.suppress(FileNotFoundError):
        _check_regular(path, os.lstat(path).st_mode)


def _check_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        what = "a symbolic link" if stat.S_ISLNK(mode) else "no regular file"
        raise MapFileError(
            f"{path} is {what}: a store is written to its own files only. Put the file itself there, or link the whole store",
            reason="not_a_map",
        )


class NamedFiles:
    """What the names of open files meant when they were opened, and how long their writer left them.

    Who removes, replaces or cuts a file leaves its writer a ghost.
    """

    def __init__(self, paths: Iterable[Path]) -> None:
        """Note the files.

        Raises:
            StorageError: one is not there.
        """
        found = {path: _look_at(path) for path in paths}
        self._known = {path: look and look[:2] for path, look in found.items()}
        self._sizes = {path: look.n_bytes for path, look in found.items() if look is not None}
        self.check()

    @contextlib.contextmanager
    def writing(self, *paths: Path) -> Iterator[None]:
        """Around a write to some of the files, by their only writer: it went into what bears their names.

        Raises:
            StorageError: see `check`, before anything is written or after it; or one is shorter than it was left.
        """
        self.check()
        for path in paths:
            n_bytes = _size_of(path)
            if n_bytes < self._sizes[path]:
                raise StorageError(
                    f"{path} has {n_bytes} bytes, and had {self._sizes[path]} when the server wrote it last: somebody else cut"
                    " it. What is written now would be lost. Put the whole store back from one copy, and start the server anew",
                    reason="gone",
                )
        try:
            yield
        finally:
            self._sizes |= {path: _size_of(path) for path in paths}
        self.check()

    def check(self) -> None:
        """See that every name still means the file that was opened.

        Raises:
            StorageError: one does not; `reason` is `gone`.
        """
        for path, known in self._known.items():
            look = _look_at(path)
            if known is None or look is None or look[:2] != known:
                raise StorageError(
                    f"{path} was removed, moved or replaced while the server writes it: what is written now would be lost. Put"
                    " the store back as it was, or start the server anew",
                    reason="gone",
                )


class _Look(NamedTuple):
    device: int
    inode: int
    n_bytes: int


def _look_at(path: Path) -> _Look | None:
    with disk_faults("look at", path):
        try:
            found = os.lstat(path)
        except (FileNotFoundError, NotADirectoryError):
            return None
    return _Look(found.st_dev, found.st_ino, found.st_size)


def _size_of(path: Path) -> int:
    look = _look_at(path)
    return -1 if look is None else look.n_bytes
