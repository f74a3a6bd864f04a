"""Atoms: on the wire, and in `*.atom` files, which hold the same message."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from potschemas import messages
from potschemas.answers import AnswerRule
from potserver.codec.base import FLOATS, decode, decode_array, float32
from potserver.codec.kernels import encode_kernels
from potserver.domain.types import Atom, KernelSet
from potserver.errors import ShapeError, TooLargeError
from potserver.limits import Limits


@np.errstate(over="ignore", invalid="ignore")  # hostile numbers may overflow on the way to their error
def decode_atom(message: messages.Atom, *, max_points: int) -> Atom:
    """An atom of the dictionary; the scalars beside its kernels belong to maps, and are left out.

    Raises:
        ShapeError: an array has the wrong dtype, shape or byte count, a number its sign does not allow, or kernels are coded.
        TooLargeError: more points or kernels than a query may have.
        BadPointsError, EmptyError: NaN or infinite points, or none.
    """
    info, kernels = message.info, message.kernels
    if kernels.nodes is not messages.ABSENT:
        raise ShapeError("atom: its kernels are told one by one, not as nodes")
    hits, free = (
        decode_array(array, name, FLOATS, (None, 3))
        for name, array in (("hit_points", message.hit_points), ("free_points", message.free_points))
    )
    hinges = decode_array(kernels.hinge_mean, "hinge_mean", FLOATS, (None, 3))
    for name, n, counted in (
        ("hits", len(hits), info.n_hits),
        ("free", len(free), info.n_free),
        ("kernels", len(hinges), info.n_kernels),
    ):
        if n > max_points:
            raise TooLargeError(f"atom with {n} {name}, the limit is {max_points}")
        if n != counted:
            raise ShapeError(f"atom: its arrays have {n} {name}, its info says {counted}")
    k = len(hinges)

    def numbers(name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        return np.asarray(decode_array(getattr(kernels, name), name, FLOATS, shape), np.float32)

    return Atom(
        atom_id=info.atom_id,
        dims=info.dims,
        hit_points=np.asarray(hits, np.float32),
        free_points=np.asarray(free, np.float32),
        kernels=KernelSet(
            hinge_mean=np.asarray(kernels.origin) + hinges,
            hinge_var=numbers("hinge_var", (k, 3)),
            **{
                name: numbers(name, (k,))
                for name in ("gamma_shape", "gamma_rate", "weight_mean", "weight_var")
            },
        ),
        radius_m=float(info.radius_m),
        azimuth_width_rad=float(info.azimuth_width_rad),
        provenance=dict(info.provenance),
    )


def read_atom_file(payload: bytes) -> Atom:
    """The atom in a `*.atom` file.

    Raises:
        BadMessageError and what `decode_atom` raises.
    """
    limits = Limits()
    message = decode(payload, messages.Atom, limits.max_query_bytes)
    return decode_atom(message, max_points=limits.max_query_points)


def encode_atom(atom: Atom, usage: Mapping[str, int], rule: AnswerRule) -> messages.Atom:
    """One atom whole; `rule` fills the scalars of the message, which readers of atoms leave out."""
    return messages.Atom(
        info=encode_atom_info(atom, usage),
        hit_points=float32(atom.hit_points),
        free_points=float32(atom.free_points),
        kernels=encode_kernels(atom.kernels, rule),
    )


def encode_atom_info(atom: Atom, usage: Mapping[str, int]) -> messages.AtomInfo:
    """An atom's line in the dictionary's table; `usage` counts the sectors that each atom has served."""
    return messages.AtomInfo(
        atom_id=atom.atom_id,
        dims=atom.dims,
        n_hits=len(atom.hit_points),
        n_free=len(atom.free_points),
        n_kernels=len(atom.kernels),
        radius_m=float(atom.radius_m),
        azimuth_width_rad=float(atom.azimuth_width_rad),
        times_used=int(usage.get(atom.atom_id, 0)),
        provenance={str(k): str(v) for k, v in atom.provenance.items()},
    )
