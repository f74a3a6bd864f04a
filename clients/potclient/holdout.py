"""Held-out beams: the only way accuracy is judged. A beam that is scored is never sent."""

from __future__ import annotations

import dataclasses

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets.scans import RecordedScan
from potclient.errors import UsageError

FREE_GAP_M = 0.5


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LabelledPoints:
    """Points of known state."""

    points: Float64  # (N, 3) m, map frame
    occupied: Bool  # (N,)

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def concatenate(parts: list[LabelledPoints]) -> LabelledPoints:
        """All points in order."""
        if not parts:
            return LabelledPoints(points=np.zeros((0, 3)), occupied=np.zeros(0, np.bool_))
        return LabelledPoints(
            points=np.concatenate([p.points for p in parts]),
            occupied=np.concatenate([p.occupied for p in parts]),
        )


class HoldOut:
    """Splits scan after scan with one seed; what is held out of a scan depends on its number alone, not on those before it.

    Each held-out beam gives its end (occupied; only if it has an echo) and, if it is longer than 0.5 m, one point that is
    uniform between the sensor and 0.5 m before the end (free).

    Args:
        fraction: Share of beams held out, in (0, 1).
        seed: Together with a scan's number, of what is held out of it.
    Raises:
        UsageError: the fraction is not in (0, 1).
    """

    def __init__(self, fraction: float = 0.2, seed: int = 0) -> None:
        if not 0.0 < fraction < 1.0:
            raise UsageError(f"hold-out fraction {fraction}: need a number between 0 and 1")
        self.fraction, self.seed = fraction, seed
        self._next = 0

    def beams(self, n: int, number: int) -> Bool:
        """(n,) which of the n beams of scan `number` are held out."""
        return self._rng(number).random(n) < self.fraction

    def split(self, scan: RecordedScan, number: int | None = None) -> tuple[RecordedScan, LabelledPoints]:
        """The scan without its held-out beams, and what those beams say.

        Args:
            scan: A whole scan.
            number: Its number in the recording; default: one more than at the call before, from 0.
        """
        number = self._next if number is None else number
        self._next = number + 1
        n = len(scan)
        held = self.beams(n, number)
        u = self._rng(number).random(2 * n)[n:]  # the numbers after those that chose the beams
        training = dataclasses.replace(scan, points=scan.points[~held], is_return=scan.is_return[~held])
        ends = scan.points[held].astype(np.float64)
        range_m = np.linalg.norm(ends, axis=1)
        has_free = range_m > FREE_GAP_M
        along = u[held][has_free] * (range_m[has_free] - FREE_GAP_M) / range_m[has_free]
        hits = ends[scan.is_return[held]]
        local = np.concatenate([hits, ends[has_free] * along[:, None]])
        return training, LabelledPoints(
            points=local @ scan.T_map_sensor[:3, :3].T + scan.T_map_sensor[:3, 3],
            occupied=np.arange(len(local)) < len(hits),
        )

    def _rng(self, number: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, number))
