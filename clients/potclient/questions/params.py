"""`q/params`: the kernels of the overall map, streamed in parts; and the stream of parameters of clouds."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import zenoh
from numpy.typing import ArrayLike

from potclient.arguments import corner
from potclient.kernels import KernelSet
from potclient.link import Link, Subscription
from potclient.parts import PartCheck
from potclient.results import TransportedParams
from potschemas import messages


def params_parts(
    link: Link, lower: ArrayLike | None, upper: ArrayLike | None, timeout_s: float | None
) -> Iterator[tuple[int, int, KernelSet]]:
    """See `MapClient.params_parts`."""
    request = messages.ParamsQuery(
        lower=None if lower is None else corner(lower, "lower").tolist(),
        upper=None if upper is None else corner(upper, "upper").tolist(),
        deadline_ms=link.deadline_ms(timeout_s),
    )
    parts = PartCheck("params")
    for part in link.stream(link.keys.query("params"), request, messages.ParamsPart, timeout_s):
        parts.add(part.part, part.n_parts, map_revision=part.map_revision)
        yield (
            part.part,
            part.n_parts,
            KernelSet.from_message(part.kernels, map_revision=part.map_revision),
        )
    parts.finish()


def watch_params(link: Link, robot: str, callback: Callable[[TransportedParams], None]) -> Subscription:
    """See `MapClient.watch_params`."""

    def deliver(message: messages.Params) -> None:
        callback(
            TransportedParams(
                robot=message.robot,
                seq=message.seq,
                stamp_ns=message.stamp_ns,
                map_revision=message.map_revision,
                kernels=KernelSet.from_message(message.kernels, map_revision=message.map_revision),
                sectors=message.sectors,
                borrowed=message.borrowed or [],
            )
        )

    key, channel = link.keys.params(robot), zenoh.handlers.RingChannel(16)
    return link.subscribe(key, messages.Params, deliver, f"params-{robot}", channel)
