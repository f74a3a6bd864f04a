"""Kernels as a client holds them: what the server sends, and the same answers without the server. numpy only."""

from __future__ import annotations

import dataclasses
import os
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.arguments import as_points
from potclient.arrays import Bool, Float32, Float64, arrays_of
from potclient.errors import BadReplyError, UsageError
from potclient.files import save_npz
from potclient.lean import lean_from_message, lean_to_message
from potclient.occupancy import Occupancy
from potclient.tile_changes import changed_nodes, kernels_of, steps_of
from potschemas import answers
from potschemas.answers import RULE_FIELDS, AnswerRule, LatentGradients, LatentSums
from potschemas.lean import LeanTiles, lean_at
from potschemas.messages import ABSENT, Kernels, TileChanges
from potschemas.wire import WireError, encode_array

_FILE_VERSION = 1
_BLOCK_ELEMENTS = 2**20  # entries of one block of the (points, kernels) matrix: 8 MiB a temporary
_LEAF_POINTS = 256  # points that are evaluated together
_MAX_EXPONENT = 44.0  # exp(-44) is 8e-20: nothing beside weights and their sums in float64


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class KernelSet:
    """K kernels in one frame (the map's, unless they are an atom's), and the rule that turns them into answers.

    f(x) = sum_m w_m exp(-gamma_m |x - h_m|^2); h, gamma and w are distributions, ten numbers a kernel in all.
    """

    hinge_mean: Float64  # (K, 3) m
    hinge_var: Float32  # (K, 3) m^2, along the frame's axes
    gamma_shape: Float32  # (K,) > 0
    gamma_rate: Float32  # (K,) m^2, > 0; E[gamma] = shape / rate
    weight_mean: Float32  # (K,) log-odds
    weight_var: Float32  # (K,) log-odds^2
    rule: AnswerRule
    map_revision: int = 0
    lean: LeanTiles | None = None  # what the kernels' sums are added to: of a map that leans

    def __post_init__(self) -> None:
        k = len(self.hinge_mean)
        for name, expected in _shapes(k).items():
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
        arrays: dict[str, Any] = {name: getattr(self, name)[index] for name in _ARRAYS}
        return dataclasses.replace(self, **arrays)

    def occupancy(
        self, points: ArrayLike, *, gradient: bool = False, evidence_only: bool = False
    ) -> Occupancy:
        """What these kernels say at points, summed in float64, by the server's own formulas (`potschemas.answers`).

        Kernels with an activation below 1e-19 are left out. Memory is bounded whatever N and K are.

        Args:
            points: (N, 3), or (N, 2) with z = 0; m, the kernels' frame.
            gradient: Give the analytic gradients of the mean and of the latent mean too; both are 0 where nothing is known.
            evidence_only: As for `MapClient.occupancy`.
        Raises:
            UsageError: wrong shape, or coordinates that are not finite.
        """
        queries = as_points(points)
        sums, slopes = self._sums(queries, gradient=gradient)
        lean = None if self.lean is None else lean_at(queries, self.lean)
        log_odds = None if lean is None else lean.log_odds
        told = answers.answer(sums, self.rule, log_odds, evidence_only=evidence_only)._asdict()
        if slopes is not None:
            of_answer = answers.gradients(sums, slopes, self.rule, lean, evidence_only=evidence_only)
            told |= {"gradient": of_answer.mean, "latent_gradient": of_answer.latent_mean}
        observed = told.pop("observed")
        return Occupancy(
            **{name: values.astype(np.float32) for name, values in told.items()},
            observed=observed,
            revisions=(self.map_revision,),
        )

    def _sums(self, points: Float64, *, gradient: bool) -> tuple[LatentSums, LatentGradients | None]:
        """The sums over all kernels at (N, 3) points, and their gradients if asked for; float64."""
        n, k = len(points), len(self)
        sums = LatentSums(*np.zeros((3, n)))
        slopes = LatentGradients(*np.zeros((3, n, 3))) if gradient else None
        if n == 0 or k == 0:
            return sums, slopes
        # Distances are taken about a local origin: |x|^2 + |h|^2 - 2 x.h loses centimetres at UTM coordinates.
        origin = self.hinge_mean.mean(axis=0)
        hinges = self.hinge_mean - origin
        gamma = self.gamma_shape.astype(np.float64) / self.gamma_rate.astype(np.float64)
        weight_var = self.weight_var.astype(np.float64)
        weights = np.stack(
            [self.weight_mean.astype(np.float64), answers.known(weight_var, self.rule)], axis=1
        )
        for rows, x, near in _neighbourhoods(points - origin, hinges, gamma):
            step = max(1, _BLOCK_ELEMENTS // len(rows))
            for first in range(0, len(near), step):
                columns = near[first : first + step]
                h, g, w, v = hinges[columns], gamma[columns], weights[columns], weight_var[columns]
                phi = _activations(x, h, g)
                mean, activation = (phi @ w).T
                sums.mean[rows] += mean
                sums.activation[rows] += activation
                if slopes is not None:
                    slopes.mean[rows] += _slopes(phi, x, h, -2.0 * g * w[:, 0])
                    slopes.activation[rows] += _slopes(phi, x, h, -2.0 * g * w[:, 1])
                np.square(phi, out=phi)
                sums.var[rows] += phi @ v
                if slopes is not None:
                    slopes.var[rows] += _slopes(phi, x, h, -4.0 * g * v)
        return sums, slopes

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an .npz (no pickle), whole or not at all; the name is taken as given."""
        save_npz(
            path,
            potclient_kernels=np.int64(_FILE_VERSION),
            map_revision=np.int64(self.map_revision),
            **{name: np.float64(value) for name, value in self.rule.fields().items()},
            **{name: getattr(self, name) for name in _ARRAYS},
            **_lean_arrays(self.lean),
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
                    # early files lack the last ones: their defaults are theirs
                    rule=AnswerRule(
                        **{n: stored[n] for n in RULE_FIELDS if n not in _LATER_RULE or n in stored}
                    ),
                    map_revision=int(stored["map_revision"]),
                    lean=_stored_lean(stored),
                    **{
                        name: stored[name].astype(np.float64 if name == "hinge_mean" else np.float32)
                        for name in _ARRAYS
                    },
                )
        except (OSError, EOFError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
            raise UsageError(f"{path}: not a kernel file that potclient saved ({error})") from error

    def to_message(self) -> Kernels:
        """The wire form; the origin is the middle of the hinges, so that float32 offsets keep their precision."""
        origin = np.round(self.hinge_mean.mean(axis=0)) if len(self) else np.zeros(3)
        arrays = {name: getattr(self, name) for name in _ARRAYS} | {"hinge_mean": self.hinge_mean - origin}
        fields: dict[str, Any] = {n: encode_array(array.astype(np.float32)) for n, array in arrays.items()}
        lean = ABSENT if self.lean is None else lean_to_message(self.lean)
        return Kernels(origin=origin.tolist(), **fields | self.rule.fields(), lean=lean)

    @classmethod
    def from_message(cls, message: Kernels, *, map_revision: int = 0) -> KernelSet:
        """The kernels of a message.

        Raises:
            BadReplyError: an array has the wrong dtype, shape or byte count, or the rule a number that is negative.
        """
        hinge = arrays_of(message, "kernels", {"hinge_mean": (None, 3)})["hinge_mean"]
        views = arrays_of(message, "kernels", _shapes(len(hinge)))
        arrays: dict[str, Any] = {name: view.astype(np.float32) for name, view in views.items()}
        arrays["hinge_mean"] = hinge.astype(np.float64) + np.asarray(message.origin, np.float64)
        try:
            rule = AnswerRule.of(message)
        except ValueError as error:
            raise BadReplyError(f"kernels: {error}") from error
        lean = None if message.lean is ABSENT else lean_from_message(message.lean)[0]
        if message.nodes is not ABSENT:
            for name, array in _nodes_of(message.nodes, np.asarray(message.origin, np.float64)).items():
                arrays[name] = np.concatenate([arrays[name], array])
        return cls(**arrays, rule=rule, map_revision=map_revision, lean=lean)

    @staticmethod
    def concatenate(sets: Iterable[KernelSet]) -> KernelSet:
        """One set of all kernels, in order.

        Raises:
            UsageError: no sets, or sets that disagree on the rule or the revision.
        """
        parts = list(sets)
        if not parts:
            raise UsageError("no kernel sets to join")
        origins = list(dict.fromkeys((p.map_revision, p.rule) for p in parts))
        if len(origins) > 1:
            raise UsageError(f"kernel sets of different maps or revisions: {origins}")
        arrays: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _ARRAYS}
        leans = [p.lean for p in parts if p.lean is not None]
        nodes = {index: own for lean in leans for index, own in lean.nodes.items()}
        lean = leans[0]._replace(nodes=nodes) if leans else None
        return dataclasses.replace(parts[0], **arrays, lean=lean)


_LATER_RULE = ("mean_moderation", "full_activation")  # of the rule, not in early files
_ARRAYS = ("hinge_mean", "hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var")


def _nodes_of(nodes: TileChanges, origin: Float64) -> dict[str, Any]:
    """The arrays of coded kernels."""
    try:
        (found,) = changed_nodes(nodes, lambda _: None, 1)
    except WireError as error:
        raise BadReplyError(f"kernels: {error}") from error
    sets = kernels_of(found, steps_of(nodes))
    if not sets:
        return {}
    arrays = {name: np.concatenate([getattr(s, name) for s in sets]) for name in _ARRAYS}
    return arrays | {"hinge_mean": arrays["hinge_mean"] + origin}


def _lean_arrays(lean: LeanTiles | None) -> dict[str, Any]:
    if lean is None or not lean.nodes:
        return {}
    return {
        "lean_tile_size_m": np.float64(lean.tile_size_m),
        "lean_tiles": np.array(list(lean.nodes), np.int64),
        "lean_nodes": np.stack(list(lean.nodes.values())),
    }


def _stored_lean(stored: Any) -> LeanTiles | None:
    if "lean_tiles" not in stored:
        return None
    index = [(x, y, z) for x, y, z in stored["lean_tiles"].tolist()]
    nodes = stored["lean_nodes"].astype(np.uint8)
    return LeanTiles(float(stored["lean_tile_size_m"]), dict(zip(index, nodes, strict=True)))


def _shapes(k: int) -> dict[str, tuple[int, ...]]:
    """Of the arrays of k kernels."""
    return {name: (k, 3) if name.startswith("hinge") else (k,) for name in _ARRAYS}


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
