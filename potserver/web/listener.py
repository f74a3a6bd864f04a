"""The HTTP server, on a thread of its own."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from typing import NamedTuple

from potclient.extras import how_to_install
from potschemas import messages
from potserver.errors import SettingsError
from potserver.log import get_logger
from potserver.threads import spawn

log = get_logger("potserver.web")

_STOP_S = 5.0


class Served(NamedTuple):
    """What HTTP needs to know of the server."""

    state: Callable[[], str]  # "serving", or what it does instead
    stats: Callable[[], messages.Stats]
    endpoint: Callable[[], str | None]  # where the page's own client connects; None while nobody can
    maps: tuple[str, ...]
    root: str


class WebListener:
    """Serves the addresses of `make_app` from its making until `close`.

    Args:
        address: HOST:PORT; port 0 takes a free one.
        served: The server.
    Raises:
        SettingsError: no such address, it is taken, or the packages of the extra `web` are missing.
    """

    def __init__(self, address: str, served: Served) -> None:
        try:
            import uvicorn

            from potserver.web.app import make_app
            from potserver.web.pages import Pages
        except ImportError as error:
            raise SettingsError(
                f"web.listen needs the packages of the extra `web`: {how_to_install('web')} ({error})"
            ) from error
        host, port = host_and_port(address)
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._socket = socket.create_server((host, port), family=family)
        except OSError as error:
            raise SettingsError(f"web.listen = {address!r}: {error.strerror or error}") from error
        found = self._socket.getsockname()
        self.address = f"[{found[0]}]:{found[1]}" if ":" in found[0] else f"{found[0]}:{found[1]}"
        self._pages = Pages(served)
        app = make_app(served.state, self._pages, served.stats)
        config = uvicorn.Config(app, log_config=None, access_log=False, lifespan="off")
        self._server = uvicorn.Server(config)
        self._thread = spawn("web", self._run)
        log.info("web_listening", address=self.address)

    def close(self) -> bool:
        """Answer no more; whether everything ended in time."""
        self._server.should_exit = True
        self._thread.join(_STOP_S)
        self._pages.close()
        with contextlib.suppress(OSError):
            self._socket.close()
        return not self._thread.is_alive()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])


def host_and_port(address: str) -> tuple[str, int]:
    """The parts of HOST:PORT; an IPv6 host stands in brackets.

    Raises:
        SettingsError: not of that form.
    """
    host, found, port = address.rpartition(":")
    if not (found and host and port.isascii() and port.isdigit() and int(port) < 2**16):
        raise SettingsError(f"web.listen = {address!r}: need HOST:PORT, e.g. 127.0.0.1:8080")
    return host.removeprefix("[").removesuffix("]"), int(port)
