"""The shipped dictionary is what its recipe gives: one of its scans is learned again."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from potserver.atoms.build.builder import scan_tasks
from potserver.atoms.build.recipe import builtin_recipe
from potserver.atoms.build.scan_task import learn_scan
from potserver.domain.dictionary import AtomDictionary

SCAN, ATOM = ("rooms", 2), "rooms-2-s4"


def test_an_atom_learned_again_is_the_shipped_one(tmp_path: Path) -> None:
    recipe = builtin_recipe()
    rooms = tuple(r for r in recipe.recordings if r.name == SCAN[0])
    tasks = scan_tasks(msgspec.structs.replace(recipe, recordings=rooms, expect_too=()), tmp_path)
    (task,) = (task for task in tasks if task.number == SCAN[1])
    again = {c.atom.atom_id: c.atom for c in learn_scan(task).candidates}[ATOM]
    shipped = AtomDictionary.builtin().get(ATOM)
    np.testing.assert_array_equal(again.hit_points, shipped.hit_points)
    np.testing.assert_array_equal(again.free_points, shipped.free_points)
    # to the bit on the machine that built it; other processors round otherwise
    np.testing.assert_allclose(again.kernels.hinge_mean, shipped.kernels.hinge_mean, atol=3e-5)
    np.testing.assert_allclose(again.kernels.weight_mean, shipped.kernels.weight_mean, atol=0.005)
