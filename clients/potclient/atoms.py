"""Atoms as a client holds them: fetched from a server, made from arrays, or read from a `*.atom` file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from potclient.arguments import numbers
from potclient.arrays import Float32, arrays_of
from potclient.errors import BadReplyError, UsageError
from potclient.files import whole
from potclient.kernels import KernelSet
from potschemas import messages
from potschemas.wire import WireError, decode, encode, encode_array


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Atom:
    """One atom of a dictionary, whole. Frame: sensor at the origin, x along the sector's bisector."""

    info: messages.AtomInfo
    hit_points: Float32  # (H, 3) m, atom frame
    free_points: Float32  # (F, 3) m, atom frame
    kernels: KernelSet  # atom frame; their rule is that of the map that was asked, and servers ignore it

    @staticmethod
    def create(
        atom_id: str,
        hit_points: ArrayLike,
        free_points: ArrayLike,
        kernels: KernelSet,
        *,
        dims: int,
        radius_m: float,
        azimuth_width_rad: float,
        provenance: Mapping[str, str] | None = None,
    ) -> Atom:
        """An atom from arrays. Values are left for the server to judge.

        Args:
            atom_id: 1 to 63 of `a-z 0-9 _ . -`.
            hit_points: (H, 3) m, atom frame: echoes.
            free_points: (F, 3) m, atom frame: free space.
            kernels: Learned on these points, atom frame.
            dims: 2 (all z are 0) or 3.
            radius_m: Of the sector, m.
            azimuth_width_rad: Opening of the sector.
            provenance: Source, scan, licence, learner, held-out scores: whatever tells where it comes from.
        Raises:
            UsageError: an argument has the wrong shape or type.
        """
        hits, free = _points(hit_points, "hit_points"), _points(free_points, "free_points")
        if dims not in (2, 3):
            raise UsageError(f"atom {atom_id}: {dims} dimensions, need 2 or 3")
        info = messages.AtomInfo(
            atom_id=atom_id,
            dims=dims,
            n_hits=len(hits),
            n_free=len(free),
            n_kernels=len(kernels),
            radius_m=float(radius_m),
            azimuth_width_rad=float(azimuth_width_rad),
            times_used=0,
            provenance={str(key): str(value) for key, value in (provenance or {}).items()},
        )
        return Atom(info=info, hit_points=hits, free_points=free, kernels=kernels)

    def to_message(self) -> messages.Atom:
        """The wire form."""
        return messages.Atom(
            info=self.info,
            hit_points=encode_array(self.hit_points),
            free_points=encode_array(self.free_points),
            kernels=self.kernels.to_message(),
        )

    @staticmethod
    def from_message(message: messages.Atom) -> Atom:
        """The atom in a message.

        Raises:
            BadReplyError: an array has the wrong dtype, shape or byte count.
        """
        what, shape = f"atom {message.info.atom_id}", (None, 3)
        points = arrays_of(message, what, {"hit_points": shape, "free_points": shape})
        return Atom(
            info=message.info,
            **{name: view.astype(np.float32) for name, view in points.items()},
            kernels=KernelSet.from_message(message.kernels),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a `*.atom` file, which is the message `pot.atom.v1`, whole or not at all."""
        with whole(path) as file:
            file.write(encode(self.to_message()))

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Atom:
        """Read what `save`, or `potserver atoms export`, wrote.

        Raises:
            UsageError: not such a file.
        """
        try:
            return Atom.from_message(decode(Path(path).read_bytes(), messages.Atom))
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror or error}") from error
        except (WireError, BadReplyError) as error:
            raise UsageError(
                f"{path}: not an *.atom file ({error}); `potserver atoms export` takes them out of a dictionary"
            ) from error


def _points(value: ArrayLike, name: str) -> Float32:
    points = numbers(value, name, np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise UsageError(f"{name}: shape {points.shape}, need (N, 3)")
    return points
