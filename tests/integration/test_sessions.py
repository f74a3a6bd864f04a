"""How many sessions a server lets in, and what is said when it is full."""

from __future__ import annotations

import resource
from typing import Any

import pytest

from potclient import AccessError, MapClient
from potserver.adapters import session as adapter

from .conftest import MakeRig, until


def test_a_full_server_says_so_and_newcomers_are_told(
    make_rig: MakeRig, caplog: pytest.LogCaptureFixture
) -> None:
    rig = make_rig(zenoh__cfg={"transport/unicast/max_sessions": 2})
    first, second = rig.client(), rig.client()
    until(lambda: first.stats().queues["sessions"] == 2, "both to be counted")
    until(lambda: "sessions_full" in caplog.text, "the warning")
    with pytest.raises(AccessError, match="has as many sessions as it may"):
        MapClient(rig.server.endpoint)
    second.close()
    until(lambda: first.stats().queues["sessions"] == 1, "the place to be free")
    with MapClient(rig.server.endpoint) as third:
        assert third.wait_ready() == "potserver"


class Files:
    """A limit of open files."""

    RLIMIT_NOFILE, RLIM_INFINITY = resource.RLIMIT_NOFILE, resource.RLIM_INFINITY

    def __init__(self, soft: int, hard: int) -> None:
        self.limit = (soft, hard)

    def getrlimit(self, _: int) -> tuple[int, int]:
        return self.limit

    def setrlimit(self, _: int, limit: tuple[int, int]) -> None:
        self.limit = limit


@pytest.mark.parametrize(
    ("soft", "hard", "fit", "raised"),
    [
        (1024, 65536, 1000, 1256),
        (1024, 1024, 768, 1024),
        (4096, 4096, 1000, 4096),
        (1024, resource.RLIM_INFINITY, 1000, 1256),
        (resource.RLIM_INFINITY, resource.RLIM_INFINITY, 1000, resource.RLIM_INFINITY),
    ],
)
def test_files_are_raised_to_what_sessions_need(
    soft: int,
    hard: int,
    fit: int,
    raised: int,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    files: Any = Files(soft, hard)
    monkeypatch.setattr(adapter, "resource", files)
    assert adapter.raise_file_limit(1000) == fit
    assert files.limit == (raised, hard)
    assert ("file_limit_low" in caplog.text) == (fit < 1000)
