"""`potserver serve`: maps for robots and planners, until a signal comes."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from potserver.commands.shared import (
    EXIT_FORCED,
    EXIT_OK,
    EXIT_UNCLEAN,
    add_settings_flags,
    add_verb,
    settings_of,
)
from potserver.errors import SettingsError
from potserver.storage.files import make_private_folder

_ABOUT = """\
Serve maps to robots and planners over Eclipse Zenoh.

The server listens on tcp/127.0.0.1:7447 only. It needs no router: robots connect to it in client mode.
It is ready when it logs server_started, and when its liveliness token is up.
One server a map: it ends with exit code 2 where another one on the network serves the same map under the same root. The
token of one that has just crashed gets 12 s to vanish.
Its maps survive restarts and crashes: every accepted cloud is on the disk before its receipt. server_started says
where they are kept (--store) and how many clouds each holds. One server a store.
Anyone who reaches the port may write: `potserver acl` writes access rules and TLS.
SIGTERM or Ctrl-C drains it: waiting clouds are mapped, everybody gets an answer, exit code 0. A second one
ends it at once."""

_EXAMPLES = """\
examples:
  potserver serve                                        one map, `default`, for this machine only
  potserver serve --listen tcp/0.0.0.0:7447              for the network: who reaches the port may write
  potserver serve --map ground --map first_floor         two maps, each with its own writer
  potserver serve --listen tcp/127.0.0.1:0               any free port; the log says which
  potserver serve --store /var/lib/site/maps             keep the maps there; --in-memory: forget them at the end
  potserver serve --read-only                            answer from the kept maps, write nothing: for a sick disk
  potserver serve --connect tcp/router:7447 --listen tcp/127.0.0.1:7448
                                                         join a Zenoh router (ROS 2 hosts have one on 7447)
  potserver serve --web 127.0.0.1:8080                   a page with the map; /live, /ready, /metrics (Prometheus)
  potserver serve --connect tcp/127.0.0.1:7447 --listen tcp/127.0.0.1:7448 --ros /points
                                                         map the PointCloud2 of ROS 2, publish its OccupancyGrid
  potserver serve --settings site.toml --set limits.max_cloud_points=100000
  POTSERVER_MAPS=ground,roof potserver serve             every setting is also a variable

settings: defaults < --settings FILE < POTSERVER_* < flags. See them all with `potserver config show`."""


def add(commands: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        commands, "serve", _run, help="serve maps until a signal comes", description=_ABOUT, epilog=_EXAMPLES
    )
    add_settings_flags(parser)
    parser.add_argument(
        "--ros",
        action="append",
        metavar="TOPIC",
        help="ROS 2 clouds to map, e.g. /points; repeatable; the map goes out as ROS 2 topics (docs/ros.md)",
    )


def _run(options: argparse.Namespace) -> int:
    from potserver.allocator import use_one_heap

    use_one_heap()
    import zenoh

    from potserver.log import configure_logging, get_logger
    from potserver.numerics.threads import use_one_blas_thread

    use_one_blas_thread()
    settings = settings_of(options)
    configure_logging(settings.log.level, settings.log.format)
    zenoh.try_init_log_from_env()  # RUST_LOG
    check_compiled(os.environ.get("NUMBA_CACHE_DIR"))
    from potserver.server import MapServer  # after the flags are known to be good

    with StopSignals.installed() as stop:
        server = MapServer(settings)
        try:
            server.start()
            stop.wait()
            get_logger("potserver.cli").info("stop_requested", signal=stop.name)
        finally:
            clean = server.stop()
    if clean:
        return EXIT_OK
    # a thread or Zenoh did not end in time: leaving the ordinary way might wait for it for ever
    sys.stderr.flush()
    os._exit(EXIT_UNCLEAN)


def check_compiled(folder: str | None) -> None:
    """See that nobody else can write where numba keeps compiled numerics; the folder is made if it is missing.

    numba pickles what it keeps: who can write there can run code as the server.

    Args:
        folder: `NUMBA_CACHE_DIR`; none: numba chooses a place of this user's.
    Raises:
        SettingsError: somebody else owns the folder, or everybody may write there. StorageError: it cannot be made.
    """
    if not folder:
        return
    make_private_folder(Path(folder))
    found = Path(folder).stat()
    if found.st_uid not in (os.getuid(), 0) or found.st_mode & stat.S_IWOTH:
        raise SettingsError(
            f"NUMBA_CACHE_DIR is {folder}, where others than this user may write, and compiled code is run from there. Name a"
            " folder of your own (chown, chmod 700)"
        )


class StopSignals:
    """SIGTERM and SIGINT: the first sets a flag, the second ends the process where it stands."""

    def __init__(self) -> None:
        self.name: str | None = None
        # The interpreter runs handlers between two of its steps, so a signal that comes just before a thread begins to wait, or
        # to another thread, would be seen when the wait ends. What its C code writes into a pipe ends the wait.
        self._read_end, self._write_end = os.pipe()
        os.set_blocking(self._write_end, False)

    @classmethod
    @contextlib.contextmanager
    def installed(cls) -> Iterator[StopSignals]:
        """Handle the signals inside the block."""
        stop = cls()
        before = {number: signal.signal(number, stop._note) for number in (signal.SIGTERM, signal.SIGINT)}
        woken_before = signal.set_wakeup_fd(stop._write_end, warn_on_full_buffer=False)
        try:
            yield stop
        finally:
            signal.set_wakeup_fd(woken_before)
            for number, handler in before.items():
                signal.signal(number, handler)
            os.close(stop._read_end)
            os.close(stop._write_end)

    def wait(self) -> None:
        """Return once a signal has come."""
        while self.name is None:
            os.read(self._read_end, 1)  # a byte a signal

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.name is not None:
            os.write(2, b"potserver: second signal, leaving at once\n")
            os._exit(EXIT_FORCED)
        self.name = signal.Signals(number).name
