"""Which atoms may join a dictionary, and how far apart atoms are."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from potschemas import keys
from potserver.atoms.admission import Refusal, admit, own_fit
from potserver.atoms.distance import atom_distances, near_in_spread
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom, KernelSet
from potserver.errors import AtomRefusedError


@pytest.fixture(scope="module")
def builtin() -> AtomDictionary:
    return AtomDictionary.builtin()


@pytest.fixture(scope="module")
def atom(builtin: AtomDictionary) -> Atom:
    """A sound 3D atom."""
    return builtin.of_dims(3).atoms[-1]


@pytest.fixture(scope="module")
def flat(builtin: AtomDictionary) -> Atom:
    """A sound 2D atom."""
    return builtin.of_dims(2).atoms[0]


def _refusal(atom: Atom, dictionary: AtomDictionary | None = None, **bounds: Any) -> AtomRefusedError:
    with pytest.raises(AtomRefusedError) as caught:
        admit(atom, dictionary or AtomDictionary(), **bounds)
    return caught.value


def _kernels(atom: Atom, **arrays: Any) -> Atom:
    return dataclasses.replace(atom, kernels=atom.kernels.replace(**arrays))


def _with(array: np.ndarray, row: Any, value: Any) -> np.ndarray:
    changed = array.copy()
    changed[row] = value
    return changed


def _first_kernel(**numbers: Any) -> Callable[[Atom], Atom]:
    """Makes atoms whose first kernel has these numbers."""

    def change(atom: Atom) -> Atom:
        return _kernels(atom, **{n: _with(getattr(atom.kernels, n), 0, v) for n, v in numbers.items()})

    return change


# --- admission ----------------------------------------------------------------------------------------------


def test_every_built_in_atom_would_be_taken_again(builtin: AtomDictionary) -> None:
    for atom in builtin:
        admit(atom, builtin.remove(atom.atom_id))


@pytest.mark.parametrize("atom_id", ["", "A", "a/b", "-a", "a" * 64, "../a", "a\n", "é"])
def test_an_illegal_id(atom: Atom, atom_id: str) -> None:
    with pytest.raises(ValueError):
        keys.check_id(atom_id, "atom")  # the same rule as that of all ids on the wire
    error = _refusal(dataclasses.replace(atom, atom_id=atom_id))
    assert error.reason == Refusal.ILLEGAL_ID
    assert error.code == "atom_refused"


def test_a_taken_id_and_a_full_dictionary(atom: Atom, flat: Atom) -> None:
    error = _refusal(atom, AtomDictionary([dataclasses.replace(flat, atom_id=atom.atom_id)]))
    assert error.reason == Refusal.TAKEN_ID
    assert _refusal(atom, AtomDictionary([flat]), max_atoms=1).reason == Refusal.FULL


_BROKEN: dict[str, tuple[Refusal, Callable[[Atom], Atom]]] = {
    "long provenance": (
        Refusal.BAD_PROVENANCE,
        lambda a: dataclasses.replace(a, provenance={"source": "x" * 5000}),
    ),
    "no radius": (Refusal.BAD_SECTOR, lambda a: dataclasses.replace(a, radius_m=0.0)),
    "nan radius": (Refusal.BAD_SECTOR, lambda a: dataclasses.replace(a, radius_m=float("nan"))),
    "huge radius": (Refusal.BAD_SECTOR, lambda a: dataclasses.replace(a, radius_m=1e4)),
    "more than a circle": (Refusal.BAD_SECTOR, lambda a: dataclasses.replace(a, azimuth_width_rad=6.4)),
    "no hits": (Refusal.NO_POINTS, lambda a: dataclasses.replace(a, hit_points=a.hit_points[:0])),
    "no free points": (Refusal.NO_POINTS, lambda a: dataclasses.replace(a, free_points=a.free_points[:0])),
    "too many hits": (
        Refusal.TOO_MANY_POINTS,
        lambda a: dataclasses.replace(a, hit_points=np.repeat(a.hit_points, 100, axis=0)),
    ),
    "no kernels": (Refusal.NO_KERNELS, lambda a: dataclasses.replace(a, kernels=KernelSet.empty())),
    "too many kernels": (
        Refusal.TOO_MANY_KERNELS,
        lambda a: dataclasses.replace(a, kernels=KernelSet.concatenate([a.kernels] * 100)),
    ),
    "a hit beyond the radius": (
        Refusal.POINTS_OUTSIDE,
        lambda a: dataclasses.replace(a, hit_points=_with(a.hit_points, 0, [10.2, 0, 0])),
    ),
    "a hit beside the sector": (
        Refusal.POINTS_OUTSIDE,
        lambda a: dataclasses.replace(a, hit_points=_with(a.hit_points, 0, [3, 3, 0])),
    ),
    "a free point behind the sensor": (
        Refusal.POINTS_OUTSIDE,
        lambda a: dataclasses.replace(a, free_points=_with(a.free_points, 0, [-0.2, 0, 0])),
    ),
    "a free point high above": (
        Refusal.POINTS_OUTSIDE,
        lambda a: dataclasses.replace(a, free_points=_with(a.free_points, 0, [3, 0, 50])),
    ),
    "a kernel far away": (Refusal.KERNELS_OUTSIDE, _first_kernel(hinge_mean=[14, 0, 0])),
    "a kernel at no place": (Refusal.KERNELS_OUTSIDE, _first_kernel(hinge_mean=[1e308, 1e308, 0])),
    "a huge weight": (Refusal.WILD_KERNELS, _first_kernel(weight_mean=1e4)),
    "a weight without doubt": (Refusal.WILD_KERNELS, _first_kernel(weight_var=0)),
    "a weight without knowledge": (Refusal.WILD_KERNELS, _first_kernel(weight_var=1e6)),
    "a needle": (Refusal.WILD_KERNELS, _first_kernel(gamma_rate=1e-30)),
    "a kernel as wide as the world": (Refusal.WILD_KERNELS, _first_kernel(gamma_rate=1e30)),
    "a hinge that may be anywhere": (Refusal.WILD_KERNELS, _first_kernel(hinge_var=1e6)),
    "weights that shout": (
        Refusal.WILD_KERNELS,
        lambda a: _kernels(a, weight_mean=a.kernels.weight_mean * 20),
    ),
    "weights of the wrong sign": (
        Refusal.UNEXPLAINED,
        lambda a: _kernels(a, weight_mean=-a.kernels.weight_mean),
    ),
    "weights that say nothing": (
        Refusal.UNEXPLAINED,
        lambda a: _kernels(a, weight_mean=np.zeros_like(a.kernels.weight_mean)),
    ),
}


@pytest.mark.parametrize("name", _BROKEN)
def test_a_broken_atom_is_refused_with_its_reason(atom: Atom, name: str) -> None:
    refusal, break_it = _BROKEN[name]
    error = _refusal(break_it(atom))
    assert error.reason == refusal.value, error


def test_an_atom_of_two_dimensions_lies_in_its_plane(flat: Atom) -> None:
    admit(flat, AtomDictionary())
    error = _refusal(dataclasses.replace(flat, hit_points=_with(flat.hit_points, 0, [3, 0, 0.5])))
    assert error.reason == Refusal.POINTS_OUTSIDE


def test_what_is_there_already_is_refused_whatever_its_name(builtin: AtomDictionary) -> None:
    rng = np.random.default_rng(0)
    for atom in builtin.of_dims(3).atoms[::6]:
        moved = (atom.hit_points + rng.normal(0, 0.02, atom.hit_points.shape)).astype(np.float32)
        inside = np.hypot(moved[:, 0], moved[:, 1]) < atom.radius_m
        again = dataclasses.replace(atom, atom_id="again", hit_points=moved[inside])
        error = _refusal(again, builtin)
        assert error.reason == Refusal.DUPLICATE
        assert repr(atom.atom_id) in str(error)


def test_twins_of_other_dimensions_do_not_count(flat: Atom) -> None:
    twin = dataclasses.replace(flat, atom_id="twin", dims=3)
    admit(twin, AtomDictionary([flat]))
    assert (
        _refusal(dataclasses.replace(flat, atom_id="twin"), AtomDictionary([flat])).reason
        == Refusal.DUPLICATE
    )


def test_own_fit_against_counting_pairs(flat: Atom) -> None:
    kernels = flat.kernels
    scores = []
    for points in (flat.hit_points, flat.free_points):
        d2 = np.square(points[:, None].astype(np.float64) - kernels.hinge_mean).sum(axis=2)
        scores.append(np.exp(-kernels.gamma.astype(np.float64) * d2) @ kernels.weight_mean)
    hits, free = scores
    wins = (hits[:, None] > free).mean() + 0.5 * (hits[:, None] == free).mean()
    assert own_fit(flat).auc == pytest.approx(wins, abs=2e-3)
    silent = _kernels(flat, weight_mean=np.zeros_like(kernels.weight_mean))
    assert own_fit(silent).auc == 0.5


def _biased(atom: Atom, log_odds: float) -> Atom:
    """The same ranking, with everything shifted: one wide kernel over the whole sector, as an attacker would add."""
    middle = atom.kernels.take(np.array([0])).replace(
        hinge_mean=np.array([[atom.radius_m / 2, 0.0, 0.0]]),
        gamma_rate=(atom.kernels.gamma_shape[:1] * 2.0 * 19.0**2).astype(np.float32),
        weight_mean=np.array([log_odds], np.float32),
    )
    return dataclasses.replace(atom, kernels=KernelSet.concatenate([atom.kernels, middle]))


@pytest.mark.parametrize("log_odds", [-20.0, 60.0], ids=["all free", "all occupied"])
def test_poison_that_keeps_the_ranking_is_refused(builtin: AtomDictionary, log_odds: float) -> None:
    """A ranking alone let such atoms in, and true walls went out of the maps that were built from them."""
    for atom in builtin.of_dims(3).atoms[::4]:
        poison = _biased(atom, log_odds)
        assert own_fit(poison).auc > 0.9
        assert _refusal(poison).reason == Refusal.UNCALIBRATED


@pytest.mark.parametrize(("n", "log_odds"), [(600, -24.0), (1, -140.0)], ids=["many", "one"])
def test_kernels_where_an_atom_has_no_points_are_refused(
    builtin: AtomDictionary, n: int, log_odds: float
) -> None:
    """Its own points cannot tell them from sound ones, and carried to another place they wipe out what stands there."""
    rng = np.random.default_rng(0)
    for atom in builtin.of_dims(3).atoms[::4]:
        points = np.concatenate([atom.hit_points, atom.free_points])
        azimuth, reach = rng.uniform(-0.5, 0.5, 20_000) * atom.azimuth_width_rad, np.sqrt(rng.random(20_000))
        flat = atom.radius_m * reach[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        places = np.append(flat, rng.uniform(-1.0, 3.0, (20_000, 1)), axis=1)
        far = [p for p in places if np.square(points - p).sum(axis=1).min() > 1.2**2][:n]
        assert len(far) == n
        full = functools.partial(np.full, n, dtype=np.float32)
        added = KernelSet(
            hinge_mean=np.array(far),
            hinge_var=np.full((n, 3), 1e-4, np.float32),
            gamma_shape=full(100.0),
            gamma_rate=full(100.0 * 2.0 * 0.35**2),
            weight_mean=full(log_odds),
            weight_var=full(0.01),
        )
        poison = dataclasses.replace(atom, kernels=KernelSet.concatenate([atom.kernels, added]))
        assert own_fit(poison).nll_hits < 0.4
        assert _refusal(poison).reason == Refusal.UNVOUCHED


def test_built_in_atoms_answer_well_at_their_own_points(builtin: AtomDictionary) -> None:
    fits = [own_fit(atom) for atom in builtin]
    assert max(fit.nll_hits for fit in fits) < 0.4
    assert max(fit.nll_free for fit in fits) < 0.5


# --- distances ----------------------------------------------------------------------------------------------


def test_distances_are_symmetric_and_find_the_equal_one(builtin: AtomDictionary) -> None:
    atoms = list(builtin.of_dims(2))[:6]
    distances = atom_distances(atoms, atoms)
    assert distances.shape == (6, 6)
    np.testing.assert_allclose(distances, distances.T, rtol=2e-2)
    assert (distances.argmin(axis=1) == np.arange(6)).all()
    np.testing.assert_allclose(atom_distances(atoms[:2], atoms, threads=2), distances[:2], rtol=1e-6)


def test_equal_atoms_have_equal_distances(builtin: AtomDictionary) -> None:
    a, b = builtin.atoms[:2]
    twin = dataclasses.replace(a, atom_id="twin")
    distances = atom_distances([a, twin], [a, twin, b])
    assert (distances[0] == distances[1]).all()
    assert distances[0, 0] == distances[0, 1]


def test_a_label_that_only_one_atom_has_cannot_be_compared(flat: Atom) -> None:
    no_hits = dataclasses.replace(flat, atom_id="a", hit_points=flat.hit_points[:0])
    no_free = dataclasses.replace(flat, atom_id="b", free_points=flat.free_points[:0])
    distances = atom_distances([flat, no_hits, no_free], [flat, no_hits, no_free])
    assert np.isfinite(distances).tolist() == np.eye(3, dtype=bool).tolist()
    assert atom_distances([], [flat]).shape == (0, 1)


def test_the_quick_bound_never_rules_out_a_near_one(builtin: AtomDictionary) -> None:
    atoms = list(builtin.of_dims(3))
    distances = atom_distances(atoms, atoms)
    ruled_out = 0
    for i, one in enumerate(atoms):
        assert near_in_spread(one, one, 1e-9)
        for j, other in enumerate(atoms):
            limit_m2 = (
                float(distances[i, j]) * 1.5
            )  # the entropic distance is above the true one, but for thinning
            assert near_in_spread(one, other, limit_m2)
            ruled_out += not near_in_spread(one, other, 0.25)
    assert ruled_out > len(atoms) ** 2 / 2
