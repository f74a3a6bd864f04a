"""`q/info` and the server's counters."""

from __future__ import annotations

from potclient.arguments import legal_id
from potclient.link import Link, decoded
from potschemas import messages
from potschemas.keys import stats_key


def info(link: Link, timeout_s: float | None = None) -> messages.Info:
    """See `MapClient.info`."""
    return link.ask(link.keys.query("info"), messages.InfoQuery(), messages.Info, timeout_s)


def stats(link: Link, server: str | None, timeout_s: float | None) -> messages.Stats:
    """See `MapClient.stats`."""
    server = info(link, timeout_s).server if server is None else legal_id(server, "server")
    key = stats_key(link.keys.root, server)
    sample = next(link.samples(key, messages.StatsQuery(), timeout_s))
    return decoded(sample.payload, messages.Stats)
