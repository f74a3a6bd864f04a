"""Stamps against the server's clock."""

from __future__ import annotations

import time

import pytest

from potserver.adapters.stamps import check_not_future
from potserver.errors import OldStampError


def test_no_stamp_may_be_far_in_the_future() -> None:
    check_not_future(0, 1.0)
    check_not_future(time.time_ns(), 1.0)
    with pytest.raises(OldStampError, match=r"up to 1.0 s ahead would be taken"):
        check_not_future(time.time_ns() + 10**10, 1.0)
