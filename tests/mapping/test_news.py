"""What is known costs less than what is new: fewer solves, parts that stay, a dictionary that is asked less."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.tiles import TiledMap
from potserver.domain.types import ParamsKind
from potserver.mapping.leaning import expect
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings

from .test_fusion import BOX, _scan, _service, _tiled

FRONT = np.array([[BOX[0, 0] + 0.05, y, z] for y in (-0.3, 0.0, 0.3) for z in (-0.4, 0.0, 0.3)])  # (9, 3) m


def _solved(service: MappingService, before: TiledMap) -> float:
    """Which share of the kernels of a map lies in tiles that were solved since."""
    tiles = _tiled(service).tiles
    moved = [t for i, t in tiles.items() if i not in before.tiles or t.kernels is not before.tiles[i].kernels]
    return sum(len(t.kernels) for t in moved) / len(service.snapshot)


def _stood(n: int, **changes: float) -> tuple[MappingService, list[float]]:
    """A robot that stands in a room for `n` scans, and what each of them had solved."""
    service, solved = _service(**{"tile_size_m": 4.0, **changes}), []
    for k in range(n):
        before = None if k == 0 else _tiled(service)
        service.integrate(_scan(k))
        if before is not None:
            solved.append(_solved(service, before))
    return service, solved


def test_a_robot_that_stands_has_less_and_less_solved() -> None:
    _, solved = _stood(60)
    assert np.mean(solved[:3]) > 0.9
    assert np.mean(solved[-20:]) < 0.5 * np.mean(solved[:3])


def test_where_evidence_ages_all_of_it_is_solved() -> None:
    _, solved = _stood(40, half_life_s=3600.0)
    assert np.mean(solved[-10:]) > 0.9


def test_what_appears_in_a_place_that_is_known_well_is_in_the_map_at_once() -> None:
    service, _ = _stood(40)
    assert service.snapshot.occupancy(FRONT).mean.max() < 0.5
    for k in range(2):
        service.integrate(_scan(100 + k, box=True))
    assert service.snapshot.occupancy(FRONT).mean.mean() > 0.5


def test_the_dictionary_is_asked_only_where_tiles_are_new(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def counted(*args: object, **named: object) -> object:
        asked.append(1)
        return expect(*args, **named)  # type: ignore[arg-type]

    monkeypatch.setattr("potserver.mapping.pipeline.expect", counted)
    service = MappingService(AtomDictionary(()), MappingSettings(), threads=1)
    for k in range(3):
        service.integrate(_scan(k), params=ParamsKind.NONE)
    assert len(asked) == 1
    service.integrate(_scan(3), params=ParamsKind.FITTED)  # a fit leans on what is expected about its scan
    assert len(asked) == 2
    service.integrate(_scan(4, at=(0.0, 0.0), shift=(100.0, 0.0, 0.0)), params=ParamsKind.NONE)
    assert len(asked) == 3
