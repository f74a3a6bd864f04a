"""Atoms of a domain, learned from its first frames and kept in files: learning is what takes longest."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from potserver.atoms.learning import LearningSettings, learn_atoms
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom
from potserver.evaluation.paper.scenes import REACH_M, Scene, open_scene
from potserver.evaluation.paper.sizes import Size
from potserver.recordings import to_scan

_N_SECTORS = 5
_OF_PLAN = {"min_hits": 12, "max_kernels": 200, "points_per_kernel": 2}  # one planar scan has few points


class Sources(NamedTuple):
    """Where atoms come from.

    Args:
        folder: Of the kept files.
        data: Folder of the recordings.
        size: Of the run.
        threads: Of the learner.
    """

    folder: Path
    data: Path | None
    size: Size
    threads: int

    def of(self, scene: Scene, frames: int | None = None) -> AtomDictionary:
        """Atoms of a domain's first frames, at 10 Hz; by default as many as the size says.

        Raises:
            NoDataError: the recording is not there.
        """
        n = frames or self.size.source_frames
        return self._kept(f"{scene.key}-first-{n}", scene, range(n))

    def pool(self, scenes: tuple[Scene, ...], n_atoms: int) -> AtomDictionary:
        """So many atoms from all along several domains, in an order drawn once: each smaller pool is part of a larger one."""
        a_scene = -(-n_atoms // (len(scenes) * (_N_SECTORS - 1)))
        atoms: list[Atom] = []
        for scene in scenes:
            n_scans = len(open_scene(scene, self.data, self.size.drive))
            spread = range(0, n_scans, max(1, n_scans // a_scene))[:a_scene]
            atoms += self._kept(f"{scene.key}-along-{a_scene}", scene, spread).atoms
        order = np.random.default_rng(0).permutation(len(atoms))
        return AtomDictionary(atoms[i] for i in order)

    def _kept(self, name: str, scene: Scene, frames: range) -> AtomDictionary:
        path = self.folder / f"{name}.atoms"
        if not path.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            AtomDictionary(self._learned(scene, frames)).save(path)
        return AtomDictionary.load(path)

    def _learned(self, scene: Scene, frames: range) -> list[Atom]:
        recording = open_scene(scene, self.data, self.size.drive)
        values = {"n_sectors": _N_SECTORS, "max_range_m": REACH_M}
        values |= _OF_PLAN if scene.planar else {}
        settings = LearningSettings(**(values | self.size.learner))
        atoms: list[Atom] = []
        for number in frames:
            provenance = {"dataset": scene.dataset, "scan": str(number), "licence": "not for distribution"}
            atoms += learn_atoms(
                to_scan(recording[number], number), f"{scene.key}-{number}", settings, provenance, seed=number,
                threads=self.threads, on_failure=lambda sector, error: None,
            )  # fmt: skip
        return atoms
