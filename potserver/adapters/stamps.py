"""Stamps against our own clock. They place clouds between poses and say how old evidence is; they order nothing."""

from __future__ import annotations

import time

from potserver.errors import OldStampError


def check_not_future(stamp_ns: int, max_future_s: float) -> None:
    """Refuse a stamp that the clock will not reach soon: map time must not run ahead, or all that was seen before fades.

    Raises:
        OldStampError: it is more than `max_future_s` ahead.
    """
    ahead_s = (stamp_ns - time.time_ns()) / 1e9
    if ahead_s > max_future_s:
        raise OldStampError(
            f"the stamp is {ahead_s:.3f} s ahead of the server's clock; one up to {max_future_s} s ahead would be taken,"
            " and any older one"
        )
