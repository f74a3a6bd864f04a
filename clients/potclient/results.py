"""What a `MapClient` gives back: frozen records with numpy arrays inside."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.errors import BadReplyError, MapServerError, UsageError, error_from_code
from potclient.files import save_npz
from potschemas import messages
from potschemas.messages import DType, ReceiptStatus, SectorReport
from potschemas.wire import WireError, decode_array

if TYPE_CHECKING:
    from potclient.kernels import KernelSet

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

_FIELDS = ("mean", "var", "latent_mean", "latent_var", "observed")
_GRADIENTS = ("gradient", "latent_gradient")


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Occupancy:
    """What a map says at N points, in the order asked."""

    mean: Float32  # (N,) P(occupied)
    var: Float32  # (N,) variance of that probability, in [0, 0.25]
    latent_mean: Float32  # (N,) log-odds
    latent_var: Float32  # (N,) log-odds^2
    observed: Bool  # (N,) false = no kernel near: unknown, which is not free
    revisions: tuple[int, ...] = (
        0,
    )  # the map revisions that answered, ascending; several only for chunked requests
    gradient: Float32 | None = None  # (N, 3) 1/m, of `mean`; 0 where unobserved; none unless asked for
    latent_gradient: Float32 | None = None  # (N, 3) log-odds/m, of `latent_mean`; likewise

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def revision(self) -> int:
        """The oldest map revision that answered a part of the request."""
        return self.revisions[0]

    @classmethod
    def from_message(
        cls, message: messages.Occupancy, n: int, what: str = "occupancy", *, with_gradient: bool = False
    ) -> Occupancy:
        """The answer in a message.

        Raises:
            BadReplyError: it does not hold n answers of the promised dtypes, or not the gradients that were asked for.
        """
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_FIELDS[:-1], (n,))
        if with_gradient:
            shapes |= dict.fromkeys(_GRADIENTS, (n, 3))
        arrays = arrays_of(message, what, shapes)
        observed = arrays_of(message, what, {"observed": (n,)}, DType.BOOL)
        return cls(**arrays, **observed, revisions=(message.map_revision,))

    @classmethod
    def empty(cls, *, with_gradient: bool) -> Occupancy:
        """The answer at no points."""
        none = np.zeros(0, np.float32)
        slopes: dict[str, Any] = (
            dict.fromkeys(_GRADIENTS, np.zeros((0, 3), np.float32)) if with_gradient else {}
        )
        return cls(
            mean=none,
            var=none,
            latent_mean=none,
            latent_var=none,
            observed=np.zeros(0, np.bool_),
            **slopes,
        )

    @staticmethod
    def concatenate(parts: list[Occupancy]) -> Occupancy:
        """All answers in order, and all revisions that gave them."""
        if len(parts) == 1:
            return parts[0]
        names = _FIELDS if parts[0].gradient is None else (*_FIELDS, *_GRADIENTS)
        arrays: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        return Occupancy(**arrays, revisions=tuple(sorted({r for p in parts for r in p.revisions})))


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Grid:
    """Occupancy at the cell centres of a box, from one map revision."""

    lower: Float64  # (3,) m, map frame: the corner where cell (0, 0, 0) starts
    resolution: float  # m, cell edge
    mean: Float32  # (nx, ny, nz) P(occupied)
    var: Float32  # (nx, ny, nz)
    latent_mean: Float32  # (nx, ny, nz) log-odds
    latent_var: Float32  # (nx, ny, nz) log-odds^2
    observed: Bool  # (nx, ny, nz)
    revision: int

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells along x, y, z."""
        nx, ny, nz = self.mean.shape
        return nx, ny, nz

    def centers(self) -> Float64:
        """(nx, ny, nz, 3) m, map frame."""
        axes = [self.lower[a] + (np.arange(n) + 0.5) * self.resolution for a, n in enumerate(self.shape)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz (no pickle), whole or not at all; `numpy.load` reads it."""
        save_npz(
            path,
            lower=self.lower,
            resolution=np.float64(self.resolution),
            revision=np.int64(self.revision),
            **{name: getattr(self, name) for name in _FIELDS},
        )


class Receipt:
    """What became of one cloud; the fields of `potschemas.messages.Receipt`, and the kernels as numpy."""

    def __init__(self, message: messages.Receipt, *, round_trip_s: float | None = None) -> None:
        self.message = message
        self.round_trip_s = (
            round_trip_s  # from the moment the cloud was given to Zenoh; None if it is not known
        )

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
        """How each sector found its atom, and how its transport ended."""
        return self.message.sectors

    @cached_property
    def kernels(self) -> KernelSet | None:
        """The instantaneous map; only the replies of `MapClient.integrate` carry it.

        Raises:
            BadReplyError: the arrays are not what the contract promises.
        """
        from potclient.kernels import KernelSet

        if self.message.kernels is None:
            return None
        return KernelSet.from_message(self.message.kernels, map_revision=self.message.map_revision)

    def error(self) -> MapServerError | None:
        """The exception that says why the cloud is not in the map; None if it is."""
        if self.accepted:
            return None
        error = error_from_code(self.reason, self.message.message or f"{self.status.value}: {self.reason}")
        error.receipt = self
        return error


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TransportedParams:
    """The transported parameters of one cloud, as published on `out/<robot>/params`."""

    robot: str
    seq: int
    stamp_ns: int
    map_revision: int
    kernels: KernelSet
    sectors: list[SectorReport]


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


def arrays_of(
    message: messages.Message, what: str, shapes: Mapping[str, tuple[int, ...]], dtype: DType = DType.FLOAT32
) -> dict[str, Any]:
    """Arrays of a message, by the names of its fields.

    Raises:
        BadReplyError: one is absent, or of another dtype, shape or byte count.
    """
    arrays = {}
    for name, shape in shapes.items():
        array = getattr(message, name)
        if array is messages.ABSENT:
            raise BadReplyError(f"{what}: no {name} came; the server is older than this question")
        try:
            arrays[name] = decode_array(array, f"{what}.{name}", dtypes=(dtype,), shape=shape)
        except WireError as error:
            raise BadReplyError(str(error)) from error
    return arrays


def as_points(points: ArrayLike) -> Float64:
    """(N, 3) float64; a third column of zeros is added to (N, 2), and one point of shape (3,) or (2,) becomes one row.

    Raises:
        UsageError: another shape, or coordinates that are not finite.
    """
    try:
        array = np.asarray(points, np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"points: not an array of numbers ({error})") from error
    if array.ndim == 1 and array.shape[0] in (2, 3):
        array = array[None, :]
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise UsageError(f"points: shape {array.shape}, need (N, 3) or (N, 2)")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise UsageError(f"points: {bad} of {len(array)} have NaN or infinite coordinates")
    if array.shape[1] == 2:
        array = np.concatenate([array, np.zeros((len(array), 1))], axis=1)
    return array
