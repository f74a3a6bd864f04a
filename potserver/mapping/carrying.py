"""Carry atoms to the sectors of a scan: rank, couple, move (paper, Algorithm 1 up to the refinement)."""

from __future__ import annotations

from typing import NamedTuple

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Sector, SectorMatch
from potserver.mapping.matching import Match, Matcher, Ranking
from potserver.mapping.transport import CouplingOptions, Transported, transport
from potserver.numerics.geometry import yaw_of
from potserver.numerics.threads import parallel_map


class Carried(NamedTuple):
    """What became of each sector of a scan; the tuples have an entry a sector."""

    sectors: list[Sector]
    matches: list[Match | None]  # none where no atom could be compared
    transported: list[Transported | None]

    def reports(self) -> list[SectorMatch]:
        """For the sender of the scan."""
        return [
            _report(s, m, t) for s, m, t in zip(self.sectors, self.matches, self.transported, strict=True)
        ]

    def served(self) -> list[tuple[Match, Transported]]:
        """The sectors that an atom was compared with; a coupling that failed has carried no kernels."""
        pairs = zip(self.matches, self.transported, strict=True)
        return [(match, done) for match, done in pairs if match is not None and done is not None]


class Carrier:
    """The atoms of a dictionary, ready to be carried. Never changes: another dictionary is another carrier."""

    def __init__(
        self,
        dictionary: AtomDictionary,
        ranking: Ranking,
        coupling: CouplingOptions,
        *,
        threads: int,
        seed: int,
    ) -> None:
        """Prepare the atoms, 2D and 3D ones apart.

        Args:
            dictionary: The atoms.
            ranking: How they are compared with sectors.
            coupling: How their kernels are moved.
            threads: Threads of one scan.
            seed: Of the points that are compared and coupled.
        """
        self.dictionary = dictionary
        self._coupling, self._threads, self._seed = coupling, threads, seed
        self._matchers = {
            dims: Matcher(dictionary.of_dims(dims), ranking, threads=threads, seed=seed) for dims in (2, 3)
        }

    def match(self, sectors: list[Sector], *, planar: bool) -> list[Match | None]:
        """The nearest atom to each sector, among those of its number of dimensions."""
        return self._matchers[2 if planar else 3].match(sectors)

    def transport(self, matches: list[Match | None], sectors: list[Sector]) -> list[Transported | None]:
        """Each sector's atom, moved to it."""

        def run(i: int) -> Transported | None:
            match = matches[i]
            return (
                None if match is None else transport(match, sectors[i], self._coupling, seed=self._seed + i)
            )

        return parallel_map(run, range(len(sectors)), self._threads)


def _report(sector: Sector, match: Match | None, transported: Transported | None) -> SectorMatch:
    turn = yaw_of(sector.T_map_sector)
    reason = None
    if match is None or transported is None:
        is_empty = len(sector.hit_points) + len(sector.free_points) == 0
        reason = "nothing in the sector" if is_empty else "no atom could be compared"
    elif not transported.converged:
        reason = "the coupling did not converge"
    return SectorMatch(
        azimuth_min_rad=sector.azimuth_min_rad + turn,
        azimuth_max_rad=sector.azimuth_max_rad + turn,
        n_hits=len(sector.hit_points),
        n_free=len(sector.free_points),
        atom_id=None if match is None or reason else match.atom.atom_id,
        rotation_rad=0.0 if match is None else match.rotation_rad,
        w2_m2=float("inf") if match is None else match.w2_m2,
        n_kernels=0 if transported is None else len(transported.kernels),
        converged=transported is not None and transported.converged,
        marginal_error=float("nan") if transported is None else transported.marginal_error,
        n_iterations=0 if transported is None else transported.n_iterations,
        reason=reason,
    )
