"""`ctl/<verb>`: changes of the map as a whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potclient.arguments import legal_id
from potclient.errors import QueryTimeoutError
from potclient.link import Link, decoded
from potschemas.messages import ABSENT, ControlReply, ControlRequest
from potschemas.wire import encode_array

CONTROL_TIMEOUT_S = 300.0  # a merge of two large maps takes a minute, and nobody should ask for it twice


def control(
    link: Link,
    verb: str,
    *,
    name: str | None,
    robot: str | None,
    T_map_saved: NDArray[np.float64] | None,
    timeout_s: float | None,
) -> ControlReply:
    """See `MapClient.control`."""
    timeout_s = CONTROL_TIMEOUT_S if timeout_s is None else timeout_s
    key = link.keys.control(legal_id(verb, "verb"))
    request = ControlRequest(
        timeout_s=timeout_s,
        name=ABSENT if name is None else legal_id(name, "name"),
        robot=ABSENT if robot is None else legal_id(robot, "robot"),
        T_map_saved=ABSENT if T_map_saved is None else encode_array(T_map_saved),
    )
    try:
        sample = next(link.samples(key, request, timeout_s))
    except QueryTimeoutError as error:
        raise QueryTimeoutError(
            f"{error}; the server may still do it: look at the map's revision before you ask again"
        ) from error
    return decoded(sample.payload, ControlReply)
