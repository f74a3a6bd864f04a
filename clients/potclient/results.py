"""What became of clouds: receipts, parameters, counts."""

from __future__ import annotations

import dataclasses
from functools import cached_property

from potclient.errors import MapServerError, error_from_code
from potclient.kernels import KernelSet
from potschemas import messages
from potschemas.messages import Borrowed, ReceiptStatus, SectorReport


class Receipt:
    """What became of one cloud; the fields of `potschemas.messages.Receipt`, and the kernels as numpy."""

    def __init__(self, message: messages.Receipt, *, round_trip_s: float | None = None) -> None:
        self.message = message
        # from the moment the cloud was given to Zenoh; None if it is not known
        self.round_trip_s = round_trip_s

    def __repr__(self) -> str:
        m = self.message
        why = f", reason={m.reason!r}" if m.reason else ""
        return f"Receipt({m.robot} #{m.seq} {m.status.value}{why}, revision={m.map_revision}, {m.integrate_ms:.0f} ms)"

    @property
    def accepted(self) -> bool:
        """The cloud is in the map."""
        return self.message.status is ReceiptStatus.ACCEPTED

    @property
    def status(self) -> ReceiptStatus:
        """accepted, dropped or rejected."""
        return self.message.status

    @property
    def reason(self) -> str | None:
        """An ErrorCode value when the cloud is not accepted."""
        return self.message.reason

    @property
    def robot(self) -> str:
        """Whose cloud it was."""
        return self.message.robot

    @property
    def seq(self) -> int:
        """The robot's number of the cloud."""
        return self.message.seq

    @property
    def map_revision(self) -> int:
        """The map's revision when the receipt was written."""
        return self.message.map_revision

    @property
    def sectors(self) -> list[SectorReport]:
        """How each sector found its atom, and how its transport ended; of transported parameters."""
        return self.message.sectors

    @property
    def borrowed(self) -> list[Borrowed]:
        """What of the dictionary fitted kernels lean on."""
        return self.message.borrowed or []

    @cached_property
    def kernels(self) -> KernelSet | None:
        """The instantaneous map; only the replies of `MapClient.integrate` carry it.

        Raises:
            BadReplyError: the arrays are not what the contract promises.
        """
        if self.message.kernels is None:
            return None
        return KernelSet.from_message(self.message.kernels, map_revision=self.message.map_revision)

    def error(self) -> MapServerError | None:
        """The exception that says why the cloud is not in the map; None if it is."""
        if self.accepted:
            return None
        error = error_from_code(self.reason, self.message.message or f"{self.status.value}: {self.reason}")
        error.receipt = self.message
        return error


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TransportedParams:
    """The parameters of one cloud, as published on `out/<robot>/params`: fitted to it, or transported."""

    robot: str
    seq: int
    stamp_ns: int
    map_revision: int
    kernels: KernelSet
    sectors: list[SectorReport]
    borrowed: list[Borrowed] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FeedCounts:
    """Where the clouds of one robot are. offered = waiting + in_flight + dropped_by_client + the five outcomes after it."""

    offered: int = 0
    waiting: int = 0  # in the slot, not sent yet
    in_flight: int = 0  # sent, no receipt yet
    sent: int = 0  # = in_flight + accepted + dropped + rejected + unknown
    dropped_by_client: int = 0  # a newer cloud took the slot, or the client closed first
    accepted: int = 0
    dropped: int = 0  # by the server, with a reason
    rejected: int = 0  # by the server, with a reason
    unknown: int = 0  # no receipt before the deadline

    @property
    def accounted(self) -> bool:
        """Every cloud that was offered has exactly one place."""
        outcomes = self.accepted + self.dropped + self.rejected + self.unknown
        return (
            self.sent == self.in_flight + outcomes
            and self.offered == self.waiting + self.dropped_by_client + self.sent
        )

    def __add__(self, other: FeedCounts) -> FeedCounts:
        return FeedCounts(
            **{f.name: getattr(self, f.name) + getattr(other, f.name) for f in dataclasses.fields(FeedCounts)}
        )
