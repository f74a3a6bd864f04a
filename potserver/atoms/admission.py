"""Which atoms may join a dictionary. Every scan of every robot is matched against them, so one bad atom spoils many maps."""

from __future__ import annotations

import functools
import math
import re
from enum import Enum
from typing import NamedTuple

import numpy as np

from potschemas.answers import AnswerRule
from potserver.atoms.distance import atom_distances, near_in_spread
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Atom, Float32, Float64
from potserver.errors import AtomRefusedError
from potserver.numerics.scores import auc

# the ids of keys and messages; an atom's id is also the name of its file
LEGAL_ID = re.compile(r"[a-z0-9][a-z0-9_.-]{0,62}")
_COMPARED = 500  # points of each label that decide on a near duplicate; with fewer, chance decides

# Bounds on an atom. The built-in ones are far inside.
MAX_ATOMS = 1_500  # each is compared with every sector, and their list is one message
_MAX_POINTS = 2_000  # of each label
_MAX_KERNELS = 4_000
_MAX_PROVENANCE_CHARS = 4_000
_MAX_RADIUS_M = 200.0
_POINT_MARGIN_M = 0.1  # that points may lie outside the sector
_KERNEL_MARGIN_M = 3.0  # that kernels may
_MAX_ABS_WEIGHT = 150.0  # log-odds; the built-in atoms reach 58
_MAX_RMS_WEIGHT = 25.0  # over the kernels; the built-in atoms reach 10.2
_MAX_WEIGHT_VAR = 1_000.0  # log-odds^2; the built-in atoms reach 199
_MIN_LENGTH_SCALE_M = 0.05  # 1 / sqrt(2 gamma)
_MAX_LENGTH_SCALE_M = 20.0
_MIN_AUC = 0.9  # of the atom's own hits over its own free points; the built-in atoms have 0.958 to 1
_MAX_OWN_NLL = (
    0.6  # of the answers at the atom's own points, each label alone; the built-in atoms reach .32 and .40
)
# Of a kernel's weight, the part that it does not say at the nearest of the atom's own points: nobody has seen that it is so.
_MAX_UNVOUCHED = 60.0  # log-odds; the built-in atoms reach 20
_MAX_RMS_UNVOUCHED = 5.0  # over the kernels; the built-in atoms reach 1.9
_AT_ONCE = 256  # kernels whose distances to all points are computed together
MIN_DISTANCE_M2 = 0.25  # to every other atom; the built-in atoms keep 2.3


class Refusal(str, Enum):
    """Why an atom may not join."""

    ILLEGAL_ID = "illegal_id"
    TAKEN_ID = "taken_id"
    FULL = "full"  # the dictionary holds as many atoms as it may
    BAD_PROVENANCE = "bad_provenance"
    BAD_SECTOR = "bad_sector"
    NO_POINTS = "no_points"  # both labels are needed: one alone cannot tell occupied from free
    NO_KERNELS = "no_kernels"
    TOO_MANY_POINTS = "too_many_points"
    TOO_MANY_KERNELS = "too_many_kernels"
    POINTS_OUTSIDE = "points_outside"
    KERNELS_OUTSIDE = "kernels_outside"
    WILD_KERNELS = "wild_kernels"  # weights, variances or widths out of range
    UNEXPLAINED = "unexplained"  # the kernels do not tell the atom's own hits from its own free points
    UNCALIBRATED = "uncalibrated"  # they rank them, and say of one label that it is the other
    UNVOUCHED = "unvouched"  # its kernels speak of places where it has no points
    DUPLICATE = "duplicate"
    TOO_FEW_SCANS = "too_few_scans"  # of those that a place is learned from


def admit(
    atom: Atom,
    dictionary: AtomDictionary,
    *,
    max_atoms: int = MAX_ATOMS,
    min_distance_m2: float = MIN_DISTANCE_M2,
    threads: int = 1,
) -> None:
    """Check an atom against the rules, the cheap ones first.

    Args:
        atom: The newcomer. Its types have checked the shapes of its arrays, and that they are finite.
        dictionary: What it would join.
        max_atoms: That a dictionary may hold.
        min_distance_m2: That two atoms must keep, squared 2-Wasserstein distance.
        threads: Threads of the comparison with the others.
    Raises:
        AtomRefusedError: it may not join; `reason` is a `Refusal`.
    """
    # wild numbers may overflow on the way to their refusal
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        _check_record(atom, dictionary, max_atoms)
        _check_counts(atom)
        _check_place(atom)
        _check_kernels(atom)
        _check_own_points(atom)
        _check_vouched(atom)
        _check_new(atom, dictionary, min_distance_m2, threads)


class OwnFit(NamedTuple):
    """How the kernels answer at the points that they were learned from. It says nothing about accuracy on other data."""

    auc: float  # hits over free points: 0.5 is a guess, near 1 for any sound atom
    nll_hits: float  # mean of -ln p(occupied)
    nll_free: float  # mean of -ln p(free)


def own_fit(atom: Atom) -> OwnFit:
    """Ask an atom at its own points; it has points of both labels."""
    own = KernelMap(atom.kernels, rule=AnswerRule(observed_activation=1e-3), threads=1)
    hits, free = (own.occupancy(points) for points in (atom.hit_points, atom.free_points))
    return OwnFit(auc(hits.latent_mean, free.latent_mean), _nll(hits.mean), _nll(1.0 - free.mean))


def _nll(p: Float64) -> float:
    return float(-np.log(np.clip(p, 1e-6, 1.0)).mean())


def _check_own_points(atom: Atom) -> None:
    """A map is only as good as what is carried into it: a ranking alone would let kernels pass that call everything free."""
    own = own_fit(atom)
    if own.auc < _MIN_AUC:
        raise refused(
            Refusal.UNEXPLAINED,
            f"its kernels tell its own hits from its own free points with AUC {own.auc:.3f}, need {_MIN_AUC}: learn it again",
        )
    for name, nll in (("hits", own.nll_hits), ("free points", own.nll_free)):
        if not nll <= _MAX_OWN_NLL:
            raise refused(
                Refusal.UNCALIBRATED,
                f"its kernels answer at its own {name} with NLL {nll:.2f}, need {_MAX_OWN_NLL}: learn it again",
            )


def _check_vouched(atom: Atom) -> None:
    """What stands where no point of the atom lies is answered for by nothing, and would be carried into maps all the same."""
    kernels = atom.kernels
    points = np.concatenate([atom.hit_points, atom.free_points]).astype(np.float64)
    square_m2 = np.concatenate(
        [
            np.square(kernels.hinge_mean[i : i + _AT_ONCE, None] - points).sum(axis=2).min(axis=1)
            for i in range(0, len(kernels), _AT_ONCE)
        ]
    )
    said = np.exp(-kernels.gamma.astype(np.float64) * square_m2)
    unvouched = np.abs(kernels.weight_mean.astype(np.float64)) * (1.0 - said)
    most, rms = float(unvouched.max()), float(np.sqrt(np.square(unvouched).mean()))
    if not (most <= _MAX_UNVOUCHED and rms <= _MAX_RMS_UNVOUCHED):
        raise refused(
            Refusal.UNVOUCHED,
            f"its kernels say up to {most:.3g} log-odds, {rms:.3g} in root mean square, where it has no points; the limits are"
            f" {_MAX_UNVOUCHED:g} and {_MAX_RMS_UNVOUCHED:g}: leave out kernels that are far from all its points",
        )


def _check_record(atom: Atom, dictionary: AtomDictionary, max_atoms: int) -> None:
    if not LEGAL_ID.fullmatch(atom.atom_id):
        raise refused(
            Refusal.ILLEGAL_ID,
            f"the id {atom.atom_id[:80]!r} is not 1 to 63 of a-z 0-9 _ . - that start with a letter or digit",
        )
    if atom.atom_id in dictionary:
        raise refused(
            Refusal.TAKEN_ID,
            f"the dictionary has an atom {atom.atom_id!r}: remove it first, or take another id",
        )
    if len(dictionary) >= max_atoms:
        raise refused(Refusal.FULL, f"the dictionary holds {len(dictionary)} atoms, the limit is {max_atoms}")
    n_chars = sum(len(key) + len(value) for key, value in atom.provenance.items())
    if n_chars > _MAX_PROVENANCE_CHARS:
        raise refused(
            Refusal.BAD_PROVENANCE,
            f"the provenance has {n_chars} characters, the limit is {_MAX_PROVENANCE_CHARS}",
        )
    if not (0 < atom.radius_m <= _MAX_RADIUS_M and 0 < atom.azimuth_width_rad <= 2 * math.pi + 1e-6):
        raise refused(
            Refusal.BAD_SECTOR,
            f"the sector has a radius of {atom.radius_m:g} m and a width of {atom.azimuth_width_rad:g} rad;"
            f" need at most {_MAX_RADIUS_M:g} m and 2 pi",
        )


def _check_counts(atom: Atom) -> None:
    for name, points in (("hits", atom.hit_points), ("free points", atom.free_points)):
        if len(points) == 0:
            raise refused(Refusal.NO_POINTS, f"it has no {name}: an atom needs points of both labels")
        if len(points) > _MAX_POINTS:
            raise refused(
                Refusal.TOO_MANY_POINTS,
                f"it has {len(points)} {name}, the limit is {_MAX_POINTS}: thin them",
            )
    if len(atom.kernels) == 0:
        raise refused(Refusal.NO_KERNELS, "it has no kernels: nothing could be carried")
    if len(atom.kernels) > _MAX_KERNELS:
        raise refused(
            Refusal.TOO_MANY_KERNELS, f"it has {len(atom.kernels)} kernels, the limit is {_MAX_KERNELS}"
        )


def _check_place(atom: Atom) -> None:
    for refusal, name, points, margin_m in (
        (Refusal.POINTS_OUTSIDE, "hit", atom.hit_points, _POINT_MARGIN_M),
        (Refusal.POINTS_OUTSIDE, "free point", atom.free_points, _POINT_MARGIN_M),
        (Refusal.KERNELS_OUTSIDE, "kernel", atom.kernels.hinge_mean, _KERNEL_MARGIN_M),
    ):
        outside_m = float(_outside(atom, points).max())
        if not outside_m <= margin_m:
            raise refused(
                refusal,
                f"a {name} lies {outside_m:.2f} m outside the sector of {math.degrees(atom.azimuth_width_rad):.0f} degrees and"
                f" {atom.radius_m:g} m, up to {margin_m:g} m are allowed: x is the sector's bisector, the sensor its apex",
            )


def _outside(atom: Atom, points: Float32 | Float64) -> Float64:
    """(N,) m: how far points lie outside the sector, or outside its plane if it has two dimensions; 0 inside."""
    x, y, z = np.asarray(points, np.float64).T
    reach = np.hypot(x, y)
    beyond_side = np.abs(np.arctan2(y, x)) - atom.azimuth_width_rad / 2.0
    # behind the apex the nearest point of the sector is the apex itself
    aside = reach * np.sin(np.clip(beyond_side, 0.0, math.pi / 2.0))
    above = np.abs(z) - (atom.radius_m if atom.dims == 3 else 0.0)
    return np.maximum.reduce([reach - atom.radius_m, aside, above, np.zeros(len(x))])


def _check_kernels(atom: Atom) -> None:
    kernels = atom.kernels
    rms = np.sqrt(np.square(kernels.weight_mean.astype(np.float64)).mean())
    length_scale = 1.0 / np.sqrt(2.0 * kernels.gamma.astype(np.float64))
    for name, values, low, high in (
        ("weight", kernels.weight_mean, -_MAX_ABS_WEIGHT, _MAX_ABS_WEIGHT),
        ("root mean square of the weights", rms, 0.0, _MAX_RMS_WEIGHT),
        ("weight variance", kernels.weight_var, 1e-9, _MAX_WEIGHT_VAR),
        ("length scale", length_scale, _MIN_LENGTH_SCALE_M, _MAX_LENGTH_SCALE_M),
        # a position that is less sure than the kernel is wide says nothing
        ("standard deviation of a hinge", np.sqrt(kernels.hinge_var), 0.0, _MAX_LENGTH_SCALE_M),
    ):
        least, most = float(values.min()), float(values.max())
        if not low <= least <= most <= high:
            raise refused(
                Refusal.WILD_KERNELS,
                f"{name}: {least:.3g} to {most:.3g}, the allowed range is {low:.3g} to {high:.3g}",
            )


def _check_new(atom: Atom, dictionary: AtomDictionary, min_distance_m2: float, threads: int) -> None:
    """Refuse what the dictionary has already. The blur of the entropy is taken off: an equal atom is at distance 0."""
    others = [
        other for other in dictionary.of_dims(atom.dims) if near_in_spread(atom, other, min_distance_m2)
    ]
    if not others:
        return
    both = [atom, *others]
    compare = functools.partial(atom_distances, n_hits=_COMPARED, n_free=_COMPARED, threads=threads)
    to_others = compare([atom], both)[0]
    own = np.array([compare([a], [a])[0, 0] for a in both])
    distance = to_others[1:] - (own[0] + own[1:]) / 2.0
    nearest = int(np.argmin(distance))
    if distance[nearest] < min_distance_m2:
        raise refused(
            Refusal.DUPLICATE,
            f"it is a near duplicate of {others[nearest].atom_id!r}: squared distance {max(distance[nearest], 0.0):.3f} m^2,"
            f" need {min_distance_m2:g}",
        )


def refused(refusal: Refusal, why: str) -> AtomRefusedError:
    """The error that says so."""
    return AtomRefusedError(why, reason=refusal.value)
