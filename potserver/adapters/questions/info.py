"""`q/info`: what this server is and what it holds."""

from __future__ import annotations

from typing import Any

from potschemas import __version__, messages
from potserver.adapters.questions.question import Asked, Question, Single, the_part
from potserver.codec.base import MAX_SMALL_BYTES
from potserver.domain.kernel_map import KernelMap
from potserver.limits import Limits


def snapshot_fields(snapshot: KernelMap) -> dict[str, Any]:
    """What a snapshot says of itself."""
    lower, upper = (None, None) if snapshot.box is None else snapshot.box.tolist()
    return {
        "map_revision": snapshot.map_revision,
        "n_kernels": len(snapshot),
        "lower": lower,
        "upper": upper,
        **snapshot.rule.fields(),
    }


def encode_limits(limits: Limits, *, max_range_m: float) -> messages.Limits:
    """What the server accepts; `max_range_m` is the mapper's."""
    names = set(messages.Limits.__struct_fields__) - {"max_range_m"}
    return messages.Limits(max_range_m=max_range_m, **{name: getattr(limits, name) for name in names})


def _encode(asked: Asked) -> messages.Info:
    served, mapper = asked.served, asked.served.mapper
    return messages.Info(
        server=served.server_id,
        version=__version__,
        map=served.map_id,
        maps=list(served.maps),
        profile=mapper.settings.profile,
        n_atoms=len(mapper.dictionary),
        n_scans=asked.state.n_scans,
        tile_size_m=float(mapper.settings.tile_size_m),
        limits=encode_limits(served.limits, max_range_m=float(mapper.settings.max_range_m)),
        started_ns=served.health.started_ns,
        durable=served.durable,
        **snapshot_fields(asked.snapshot),
    )


def _plan(asked: Asked, _query: messages.InfoQuery) -> Single:
    return Single(lambda: _encode(asked), is_short=True)


QUESTION = Question(
    op="info",
    query=messages.InfoQuery,
    plan=_plan,
    each=the_part,
    reads_tiles=False,
    max_bytes=MAX_SMALL_BYTES,
)
