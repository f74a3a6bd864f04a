"""MapPart: some kernels of a map, made ready to be asked. A map's parts that a scan did not touch stay as they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from functools import cache

import numpy as np

from potschemas.answers import AnswerRule, known
from potserver.domain.types import Float64, KernelSet
from potserver.numerics.bricks import LatticeBricks, NodeKernels, Part, bricks_of
from potserver.numerics.kernel_index import KernelIndex, build_index

_SAME_M = 1e-3  # heights that differ by less are one


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class MapPart:
    """Kernels on lattices as bricks, the others in an index."""

    members: tuple[tuple[KernelSet, Float64], ...]  # with what moves them into the map frame, (3,) m
    bricks: tuple[LatticeBricks, ...] = ()
    rest: KernelSet  # on no lattice, map frame
    lookup: KernelIndex  # of the rest
    n_kernels: int
    box: Float64  # (2, 3) m, map frame: corners of the hinges' box; without kernels the lower one is infinite

    @staticmethod
    def of(kernels: KernelSet, rule: AnswerRule = AnswerRule()) -> MapPart:
        """Index kernels in the map frame, for maps with this `observed_activation` and `prior_var`."""
        return MapPart(
            members=((kernels, np.zeros(3)),),
            rest=kernels,
            lookup=_indexed(kernels, rule),
            n_kernels=len(kernels),
            box=_box(kernels.hinge_mean),
        )

    @staticmethod
    def of_tiles(
        tiles: Mapping[tuple[int, int, int], KernelSet], part: Part, rule: AnswerRule = AnswerRule()
    ) -> MapPart:
        """Put the kernels of tiles into bricks, where they stand on lattices.

        Args:
            tiles: At least one, by floor(p_map / tile_size_m), relative to their lower corners.
            part: The part that they are of.
            rule: Its `observed_activation` and `prior_var` are what maps of this part have.
        """
        sets, index = list(tiles.values()), np.array(list(tiles), np.int64)
        counts = [len(kernels) for kernels in sets]
        of_tile = np.repeat(index, counts, axis=0)
        hinge, gamma, weight, variance = (
            np.concatenate([getattr(kernels, name) for kernels in sets])
            for name in ("hinge_mean", "gamma", "weight_mean", "weight_var")
        )
        in_part = of_tile - np.array(part.number) * part.tiles
        made, is_rest = bricks_of(
            NodeKernels(hinge, in_part, gamma, weight, variance, known(variance, rule)), part
        )
        rest, lookup = KernelSet.empty(), _no_index()
        if is_rest.any():
            rest = (
                KernelSet.concatenate(sets)
                .take(is_rest)
                .moved(np.asarray(of_tile[is_rest] * part.tile_m, np.float64))
            )
            lookup = _indexed(rest, rule)
        shifts = np.asarray(index * part.tile_m, np.float64)
        return MapPart(
            members=tuple(zip(sets, shifts, strict=True)),
            bricks=tuple(made),
            rest=rest,
            lookup=lookup,
            n_kernels=sum(counts),
            box=_box(hinge + of_tile * part.tile_m),
        )

    def is_of(self, sets: Collection[KernelSet]) -> bool:
        """Whether it was made of just these sets of kernels, in this order."""
        return len(sets) == len(self.members) and all(
            a is b for a, (b, _) in zip(sets, self.members, strict=True)
        )

    @property
    def kernels(self) -> KernelSet:
        """All kernels, map frame; put together anew each time."""
        return KernelSet.concatenate([kernels.moved(shift) for kernels, shift in self.members])


def in_a_plane(parts: Collection[MapPart]) -> bool:
    """Whether the kernels of a map's parts all stand at one height; not if there are none."""
    heights = np.array([part.box[:, 2] for part in parts if part.n_kernels])
    return bool(len(heights)) and float(np.ptp(heights)) < _SAME_M


def _box(hinge: Float64) -> Float64:
    return np.stack([hinge.min(axis=0, initial=np.inf), hinge.max(axis=0, initial=-np.inf)])


@cache
def _no_index() -> KernelIndex:
    """Of no kernels: most parts have none that stand on no lattice."""
    return _indexed(KernelSet.empty(), AnswerRule())


def _indexed(kernels: KernelSet, rule: AnswerRule) -> KernelIndex:
    return build_index(
        kernels.hinge_mean,
        kernels.gamma,
        kernels.weight_mean,
        kernels.weight_var,
        activation_cut=rule.observed_activation / 20.0,
        prior_var=rule.prior_var,
    )
