"""From beams to labelled points: where an echo came from is occupied, what the beam crossed is free (paper, section II-A)."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Bool, Float64, Floats, Int64


class LabelledPoints(NamedTuple):
    """Points with their labels, and the beam that each one belongs to."""

    points: Float64  # (N, 3) m, in the frame of the beams
    occupied: Bool  # (N,) true = hit (y = 1), false = free (y = 0)
    beam: Int64  # (N,) number of the beam


class Beams(NamedTuple):
    """Beams that start at one place and end at `ends`."""

    ends: Float64  # (N, 3) m, relative to the start
    is_return: Bool  # (N,) false = no echo: free up to the end

    def take(self, index: Int64 | Bool) -> Beams:
        """The beams that a numpy index picks."""
        return Beams(self.ends[index], self.is_return[index])


def limit_range(beams: Beams, min_range_m: float, max_range_m: float) -> Beams:
    """Leave out beams shorter than `min_range_m`; cut longer ones than `max_range_m`, which then end without an echo."""
    keep = long_enough(beams.ends, min_range_m)
    return cut_range(beams.take(keep), max_range_m)


def long_enough(ends: Floats, min_range_m: float) -> Int64:
    """Numbers of those of (N, 3) ends that are as far as `min_range_m` from the start, and not at it."""
    squared = np.einsum("ij,ij->i", ends, ends, dtype=np.float64)
    return np.flatnonzero((squared >= min_range_m**2) & (squared > 0))


def cut_range(beams: Beams, max_range_m: float) -> Beams:
    """Cut longer beams than `max_range_m`, which then end without an echo; all are longer than 0."""
    length = np.linalg.norm(beams.ends, axis=1)
    too_long = length > max_range_m
    scale = np.where(too_long, max_range_m / length, 1.0)
    return Beams(beams.ends * scale[:, None], beams.is_return & ~too_long)


def label_beams(
    beams: Beams, *, free_per_beam: int, gap_m: float, rng: np.random.Generator
) -> LabelledPoints:
    """Hits at the ends of returned beams; free points along every beam.

    Args:
        beams: N beams.
        free_per_beam: Free points a beam, one in each of that many equal pieces of it (stratified).
        gap_m: No free point lies closer than this to the end of a returned beam.
        rng: Where in its piece each free point falls.
    Returns:
        Hits first, in beam order; then the free points, in beam order.
    """
    length = np.linalg.norm(beams.ends, axis=1)
    usable = np.where(beams.is_return, length - gap_m, length)
    n_free = int((usable > 0).sum()) * free_per_beam
    where = rng.random(n_free)
    return LabelledPoints(*_label(beams.ends, beams.is_return, length, usable, where, free_per_beam))


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _label(ends, is_return, length, usable, where, free_per_beam):
    n_hits = is_return.sum()
    n = n_hits + len(where)
    points, occupied, beam = np.empty((n, 3)), np.zeros(n, np.bool_), np.empty(n, np.int64)
    hit, free = 0, 0
    for b in range(len(ends)):
        if is_return[b]:
            points[hit], occupied[hit], beam[hit] = ends[b], True, b
            hit += 1
        if usable[b] > 0:
            share = usable[b] / length[b]
            for k in range(free_per_beam):
                fraction = (k + where[free]) / free_per_beam * share
                for c in range(3):
                    points[n_hits + free, c] = ends[b, c] * fraction
                beam[n_hits + free] = b
                free += 1
    return points, occupied, beam


def beam_weights(labelled: LabelledPoints) -> Float64:
    """(N,) how much each point counts: a beam's hit 1, and its free points 1 together.

    A beam's hit and its free space then weigh the same, however many free points are drawn, and a fit needs no bias term.
    """
    n_beams = int(labelled.beam.max(initial=-1)) + 1
    share = 1.0 / np.maximum(np.bincount(labelled.beam[~labelled.occupied], minlength=n_beams), 1)
    return np.where(labelled.occupied, 1.0, share[labelled.beam])
