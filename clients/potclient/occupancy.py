"""What a map answers: occupancy at points, and at the cells of a grid."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from potclient.arrays import Bool, Float32, Float64, arrays_of
from potclient.files import save_npz
from potschemas import messages
from potschemas.answers import occupancy_var
from potschemas.messages import DType

_FIELDS = ("mean", "var", "latent_mean", "latent_var", "observed", "borrowed")
_ALWAYS = ("mean", "var", "latent_mean", "latent_var")
_GRADIENTS = ("gradient", "latent_gradient")


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Occupancy:
    """What a map says at N points, in the order asked."""

    mean: Float32  # (N,) P(occupied)
    var: Float32  # (N,) variance of that probability: its squared error as expected, in [0, 0.25]
    latent_mean: Float32  # (N,) log-odds
    latent_var: Float32  # (N,) log-odds^2
    observed: Bool  # (N,) false = nothing was seen near: `mean` is 0.5, or what the map expects there
    borrowed: Float32  # (N,) in [0, 1]: the share of the answer that is expected and not seen
    # the map revisions that answered, ascending; several only for chunked requests
    revisions: tuple[int, ...] = (0,)
    gradient: Float32 | None = None  # (N, 3) 1/m, of `mean`; 0 where nothing is known; none unless asked for
    latent_gradient: Float32 | None = None  # (N, 3) log-odds/m, of `latent_mean`; likewise

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def revision(self) -> int:
        """The oldest map revision that answered a part of the request."""
        return self.revisions[0]

    @classmethod
    def from_message(
        cls, message: messages.Occupancy, n: int, what: str = "occupancy", *, with_gradient: bool = False
    ) -> Occupancy:
        """The answer in a message.

        Raises:
            BadReplyError: it does not hold n answers of the promised dtypes, or not the gradients that were asked for.
        """
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_ALWAYS, (n,))
        if with_gradient:
            shapes |= dict.fromkeys(_GRADIENTS, (n, 3))
        arrays = arrays_of(message, what, shapes)
        observed = arrays_of(message, what, {"observed": (n,)}, DType.BOOL)
        borrowed = np.zeros(n, np.float32)
        if message.borrowed is not messages.ABSENT:
            borrowed = arrays_of(message, what, {"borrowed": (n,)})["borrowed"]
        return cls(**arrays, **observed, borrowed=borrowed, revisions=(message.map_revision,))

    @classmethod
    def empty(cls, *, with_gradient: bool) -> Occupancy:
        """The answer at no points."""
        none = np.zeros(0, np.float32)
        slopes: dict[str, Any] = (
            dict.fromkeys(_GRADIENTS, np.zeros((0, 3), np.float32)) if with_gradient else {}
        )
        return cls(
            mean=none,
            var=none,
            latent_mean=none,
            latent_var=none,
            observed=np.zeros(0, np.bool_),
            borrowed=none,
            **slopes,
        )

    @staticmethod
    def concatenate(parts: list[Occupancy]) -> Occupancy:
        """All answers in order, and all revisions that gave them."""
        if len(parts) == 1:
            return parts[0]
        names = _FIELDS if parts[0].gradient is None else (*_FIELDS, *_GRADIENTS)
        arrays: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        return Occupancy(**arrays, revisions=tuple(sorted({r for p in parts for r in p.revisions})))


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Grid:
    """Occupancy at the cell centres of a box, from one map revision."""

    lower: Float64  # (3,) m, map frame: the corner where cell (0, 0, 0) starts
    resolution: float  # m, cell edge
    mean: Float32  # (nx, ny, nz) P(occupied)
    var: Float32  # (nx, ny, nz)
    latent_mean: Float32  # (nx, ny, nz) log-odds
    latent_var: Float32  # (nx, ny, nz) log-odds^2
    observed: Bool  # (nx, ny, nz)
    borrowed: Float32  # (nx, ny, nz)
    revision: int

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells along x, y, z."""
        nx, ny, nz = self.mean.shape
        return nx, ny, nz

    def centers(self) -> Float64:
        """(nx, ny, nz, 3) m, map frame."""
        axes = [self.lower[a] + (np.arange(n) + 0.5) * self.resolution for a, n in enumerate(self.shape)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz (no pickle), whole or not at all; `numpy.load` reads it."""
        save_npz(
            path,
            lower=self.lower,
            resolution=np.float64(self.resolution),
            revision=np.int64(self.revision),
            **{name: getattr(self, name) for name in _FIELDS},
        )


def surface_var(answer: Occupancy | Grid, at: Any = ...) -> Float64:
    """Variance of the occupancy probability by that of its latent, at some places of an answer: what colours surfaces.

    There the mean is one half, and the expected squared error, `var`, is the same everywhere.
    """
    found: Float64 = occupancy_var(answer.mean[at].astype(np.float64), answer.latent_var[at])
    return found
