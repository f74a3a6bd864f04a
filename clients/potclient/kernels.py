"""Kernels as a client holds them: what the server sends, and the same answers without the server. numpy only."""

from __future__ import annotations

import dataclasses
import math
import os
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.errors import BadReplyError, UsageError
from potclient.files import save_npz
from potclient.results import Bool, Float32, Float64, Occupancy, as_points
from potschemas.messages import Array, DType, Kernels
from potschemas.wire import WireError, decode_array, encode_array

_FILE_VERSION = 1
_BLOCK_ELEMENTS = 2**20  # entries of one block of the (points, kernels) matrix: 8 MiB a temporary
_LEAF_POINTS = 256  # points that are evaluated together
_MAX_EXPONENT = 44.0  # exp(-44) is 8e-20: nothing beside weights and their sums in float64


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class KernelSet:
    """K kernels in one frame (the map's, unless they are an atom's), and the scalars that turn them into answers.

    f(x) = sum_m w_m exp(-gamma_m |x - h_m|^2); h, gamma and w are distributions, ten numbers a kernel in all.
    """

    hinge_mean: Float64  # (K, 3) m
    hinge_var: Float32  # (K, 3) m^2, along the frame's axes
    gamma_shape: Float32  # (K,) > 0
    gamma_rate: Float32  # (K,) m^2, > 0; E[gamma] = shape / rate
    weight_mean: Float32  # (K,) log-odds
    weight_var: Float32  # (K,) log-odds^2
    observed_activation: float  # summed activation below which a point counts as unobserved
    prior_var: float  # log-odds^2, the latent variance of an unobserved point
    residual_var: float  # log-odds^2, added in the measure that the summed activation falls short of 1
    mean_moderation: float = 1.0  # share of the latent variance that pulls the mean towards 0.5
    map_revision: int = 0

    def __post_init__(self) -> None:
        k = len(self.hinge_mean)
        for name, shape in _SHAPES.items():
            expected = (k, 3) if shape == 2 else (k,)
            if getattr(self, name).shape != expected:
                raise UsageError(f"{name}: shape {getattr(self, name).shape}, need {expected}")

    def __len__(self) -> int:
        return len(self.hinge_mean)

    @property
    def gamma(self) -> Float32:
        """(K,) 1/m^2: the mean of each kernel's Gamma distribution."""
        return np.asarray(self.gamma_shape / self.gamma_rate, np.float32)

    @property
    def n_bytes(self) -> int:
        """Size of the ten numbers of each kernel on the wire, without the few bytes around them."""
        return 40 * len(self)

    def take(self, index: NDArray[np.intp] | Bool | slice) -> KernelSet:
        """The kernels that a numpy index picks."""
        arrays: dict[str, Any] = {name: getattr(self, name)[index] for name in _SHAPES}
        return dataclasses.replace(self, **arrays)

    def occupancy(self, points: ArrayLike, *, gradient: bool = False) -> Occupancy:
        """What these kernels say at points: the formulas of the server, in float64.

        With mu = f(x) and s2 = sum_m var_m phi_m^2 + residual_var max(0, 1 - sum_m phi_m):
        mean = sigmoid(mu / sqrt(1 + c pi s2 / 8)), c = `mean_moderation`, and
        var = mean (1 - mean) (1 - 1 / sqrt(1 + pi s2 / 8)). Where the summed
        activation stays below `observed_activation` the answer is 0.5, latent mean 0 and latent variance `prior_var`, and
        `observed` is false. Kernels with an activation under 1e-19 are left out;
        memory is bounded whatever N and K are.

        Args:
            points: (N, 3), or (N, 2) with z = 0; m, the kernels' frame.
            gradient: Give the analytic gradients of the mean and of the latent mean too; both are 0 where unobserved.
        Raises:
            UsageError: wrong shape, or coordinates that are not finite.
        Source: mean, MacKay 1992; variance, Daunizeau 2017 (semi-analytical moments of the logistic-normal).
        """
        queries = as_points(points)
        n, k = len(queries), len(self)
        latent_mean, latent_var, activation = np.zeros(n), np.zeros(n), np.zeros(n)
        mean_slope, var_slope, activation_slope = np.zeros((3, n, 3))
        if n and k:
            # Distances are taken about a local origin: |x|^2 + |h|^2 - 2 x.h loses centimetres at UTM coordinates.
            origin = self.hinge_mean.mean(axis=0)
            hinges = self.hinge_mean - origin
            gamma = self.gamma_shape.astype(np.float64) / self.gamma_rate.astype(np.float64)
            weights = np.stack([np.ones(k), self.weight_mean.astype(np.float64)], axis=1)
            weight_var = self.weight_var.astype(np.float64)
            for rows, x, near in _neighbourhoods(queries - origin, hinges, gamma):
                step = max(1, _BLOCK_ELEMENTS // len(rows))
                for first in range(0, len(near), step):
                    columns = near[first : first + step]
                    phi = _activations(x, hinges[columns], gamma[columns])
                    sums = phi @ weights[columns]
                    activation[rows] += sums[:, 0]
                    latent_mean[rows] += sums[:, 1]
                    if gradient:
                        h, g = hinges[columns], gamma[columns]
                        mean_slope[rows] += _slopes(phi, x, h, -2.0 * g * weights[columns, 1])
                        activation_slope[rows] += _slopes(phi, x, h, -2.0 * g)
                    np.square(phi, out=phi)
                    latent_var[rows] += phi @ weight_var[columns]
                    if gradient:
                        var_slope[rows] += _slopes(phi, x, h, -4.0 * g * weight_var[columns])
        observed = activation >= self.observed_activation if k else np.zeros(n, np.bool_)
        latent_var += self.residual_var * np.maximum(1.0 - activation, 0.0)
        # the residual variance falls only where it is there: below an activation of 1
        var_slope -= np.where(activation < 1.0, self.residual_var, 0.0)[:, None] * activation_slope
        latent_mean[~observed] = 0.0
        latent_var[~observed] = self.prior_var
        scale = 1.0 / np.sqrt(1.0 + (math.pi / 8.0) * latent_var)
        pull = 1.0 / np.sqrt(1.0 + (self.mean_moderation * math.pi / 8.0) * latent_var)
        mean = _sigmoid(latent_mean * pull)
        slopes: dict[str, Float32] = {}
        if gradient:
            by_var = (self.mean_moderation * math.pi / 16.0) * latent_mean * pull**3
            mean_gradient = (mean * (1.0 - mean))[:, None] * (
                pull[:, None] * mean_slope - by_var[:, None] * var_slope
            )
            for name, slope in (("gradient", mean_gradient), ("latent_gradient", mean_slope)):
                slopes[name] = np.where(observed[:, None], slope, 0.0).astype(np.float32)
        return Occupancy(
            mean=mean.astype(np.float32),
            var=(mean * (1.0 - mean) * (1.0 - scale)).astype(np.float32),
            latent_mean=latent_mean.astype(np.float32),
            latent_var=latent_var.astype(np.float32),
            observed=observed,
            revisions=(self.map_revision,),
            **slopes,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz (no pickle), whole or not at all; the name is taken as given."""
        save_npz(
            path,
            potclient_kernels=np.int64(_FILE_VERSION),
            observed_activation=np.float64(self.observed_activation),
            prior_var=np.float64(self.prior_var),
            residual_var=np.float64(self.residual_var),
            mean_moderation=np.float64(self.mean_moderation),
            map_revision=np.int64(self.map_revision),
            **{name: getattr(self, name) for name in _SHAPES},
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> KernelSet:
        """Read what `save` wrote.

        Raises:
            UsageError: not such a file, or one of another version.
        """
        try:
            with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as stored:
                version = int(stored["potclient_kernels"])
                if version != _FILE_VERSION:
                    raise UsageError(
                        f"{path}: kernel file of version {version}, this client reads {_FILE_VERSION}"
                    )
                return cls(
                    observed_activation=float(stored["observed_activation"]),
                    prior_var=float(stored["prior_var"]),
                    residual_var=float(stored["residual_var"]),
                    # files of before it was a choice have the full share
                    mean_moderation=float(stored["mean_moderation"]) if "mean_moderation" in stored else 1.0,
                    map_revision=int(stored["map_revision"]),
                    **{
                        name: stored[name].astype(np.float64 if name == "hinge_mean" else np.float32)
                        for name in _SHAPES
                    },
                )
        except (OSError, EOFError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
            raise UsageError(f"{path}: not a kernel file that potclient saved ({error})") from error

    def to_message(self) -> Kernels:
        """The wire form; the origin is the middle of the hinges, so that float32 offsets keep their precision."""
        origin = np.round(self.hinge_mean.mean(axis=0)) if len(self) else np.zeros(3)
        return Kernels(
            origin=[float(v) for v in origin],
            hinge_mean=encode_array((self.hinge_mean - origin).astype(np.float32)),
            hinge_var=encode_array(self.hinge_var.astype(np.float32)),
            gamma_shape=encode_array(self.gamma_shape.astype(np.float32)),
            gamma_rate=encode_array(self.gamma_rate.astype(np.float32)),
            weight_mean=encode_array(self.weight_mean.astype(np.float32)),
            weight_var=encode_array(self.weight_var.astype(np.float32)),
            observed_activation=self.observed_activation,
            prior_var=self.prior_var,
            residual_var=self.residual_var,
            mean_moderation=self.mean_moderation,
        )

    @classmethod
    def from_message(cls, message: Kernels, *, map_revision: int = 0) -> KernelSet:
        """The kernels of a message.

        Raises:
            BadReplyError: an array of the message has the wrong dtype, shape or byte count.
        """

        def array(name: str, wire: Array, shape: tuple[int | None, ...]) -> Float32:
            return decode_array(wire, name, dtypes=(DType.FLOAT32,), shape=shape).astype(np.float32)

        try:
            hinge = array("hinge_mean", message.hinge_mean, (None, 3))
            k = len(hinge)
            return cls(
                hinge_mean=hinge.astype(np.float64) + np.asarray(message.origin, np.float64),
                hinge_var=array("hinge_var", message.hinge_var, (k, 3)),
                gamma_shape=array("gamma_shape", message.gamma_shape, (k,)),
                gamma_rate=array("gamma_rate", message.gamma_rate, (k,)),
                weight_mean=array("weight_mean", message.weight_mean, (k,)),
                weight_var=array("weight_var", message.weight_var, (k,)),
                observed_activation=message.observed_activation,
                prior_var=message.prior_var,
                residual_var=message.residual_var,
                mean_moderation=message.mean_moderation,
                map_revision=map_revision,
            )
        except WireError as error:
            raise BadReplyError(f"kernels: {error}") from error

    @staticmethod
    def concatenate(sets: Iterable[KernelSet]) -> KernelSet:
        """One set of all kernels, in order.

        Raises:
            UsageError: no sets, or sets that disagree on the scalars or the revision.
        """
        parts = list(sets)
        if not parts:
            raise UsageError("no kernel sets to join")
        scalars = {
            (p.observed_activation, p.prior_var, p.residual_var, p.mean_moderation, p.map_revision)
            for p in parts
        }
        if len(scalars) > 1:
            raise UsageError(f"kernel sets of different maps or revisions: {sorted(scalars)}")
        arrays: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _SHAPES}
        return dataclasses.replace(parts[0], **arrays)


_SHAPES = {
    "hinge_mean": 2,
    "hinge_var": 2,
    "gamma_shape": 1,
    "gamma_rate": 1,
    "weight_mean": 1,
    "weight_var": 1,
}


def _neighbourhoods(
    points: Float64, hinges: Float64, gamma: Float64
) -> Iterator[tuple[NDArray[np.intp], Float64, NDArray[np.intp]]]:
    """Halve the points until few are left, and drop on the way down the kernels that do not reach a half.

    Args:
        points: (N, 3) m.
        hinges: (K, 3) m.
        gamma: (K,) 1/m^2.
    Yields:
        Rows of points, those points, and the kernels that matter to them; every point once, unless no kernel reaches it.
    """
    waiting = [(np.arange(len(points)), np.arange(len(hinges)))]
    while waiting:
        rows, near = waiting.pop()
        x = points[rows]
        lower, upper = x.min(axis=0), x.max(axis=0)
        outside = np.maximum(np.maximum(lower - hinges[near], hinges[near] - upper), 0.0)
        near = near[gamma[near] * np.einsum("kd,kd->k", outside, outside) < _MAX_EXPONENT]
        if len(near) == 0:
            continue
        if len(rows) <= _LEAF_POINTS:
            yield rows, x, near
            continue
        half = len(rows) // 2
        order = np.argpartition(x[:, np.argmax(upper - lower)], half)
        waiting += [(rows[order[:half]], near), (rows[order[half:]], near)]


def _activations(x: Float64, hinges: Float64, gamma: Float64) -> Float64:
    """(N, K): exp(-gamma |x - h|^2), made in place."""
    phi: Float64 = x @ hinges.T
    phi *= -2.0
    phi += np.einsum("nd,nd->n", x, x)[:, None]
    phi += np.einsum("kd,kd->k", hinges, hinges)
    np.maximum(phi, 0.0, out=phi)
    phi *= -gamma
    return np.exp(phi, out=phi)


def _slopes(phi: Float64, x: Float64, hinges: Float64, factor: Float64) -> Float64:
    """(N, 3): sum_m factor_m phi_m (x - h_m)."""
    return x * (phi @ factor)[:, None] - phi @ (factor[:, None] * hinges)


def _sigmoid(x: Float64) -> Float64:
    """1 / (1 + exp(-x)) without overflow."""
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0 / (1.0 + e), e / (1.0 + e))
