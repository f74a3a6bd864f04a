"""Kernels for the wire: as they are, and coded; coded ones are short where they share something, and the same numbers."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from potclient.errors import BadReplyError
from potclient.kernels import KernelSet as ClientKernels
from potclient.mirror import MapMirror
from potschemas import messages, wire
from potschemas.answers import AnswerRule
from potschemas.lean import LeanTiles
from potschemas.messages import DType
from potserver.codec.kernels import code_kernels, encode_kernels, encode_own_map
from potserver.domain.types import KernelSet, OwnMap
from tests.tiled_maps import GRID, asking, free_kernels, lattice_kernels, tiled_state

RULE = AnswerRule(observed_activation=0.05, prior_var=50.0, residual_var=20.0, mean_moderation=0.25)
SPACINGS = (GRID.coarse_m, GRID.fine_m)
BOTH = KernelSet.concatenate([lattice_kernels(300, spacing_m=GRID.coarse_m), lattice_kernels(500, 1)])


def n_bytes(coded: messages.CodedKernels) -> int:
    fields = [getattr(coded, name) for name in coded.__struct_fields__]
    return sum(len(field.deflated) for field in fields if field is not None)


def sent(kernels: KernelSet, index: tuple[int, int, int] = (0, 0, 0)) -> ClientKernels:
    """What a client holds of one tile of these kernels."""
    mirror = MapMirror(asking(lambda: tiled_state({index: (kernels, 1)})))
    mirror.update()
    return mirror.kernels


def assert_same(arrived: ClientKernels, kernels: KernelSet) -> None:
    np.testing.assert_array_equal(arrived.hinge_mean, kernels.hinge_mean.astype(np.float32))
    for name in ("hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        array = getattr(arrived, name)
        assert array.dtype == np.float32
        assert array.tobytes() == getattr(kernels, name).tobytes(), name  # -0 too


@pytest.mark.parametrize(
    "kernels",
    [
        BOTH,
        free_kernels(200),
        KernelSet.concatenate([BOTH, free_kernels(200)]),
        lattice_kernels(100, planar=True),
        lattice_kernels(1),
        free_kernels(3),
    ],
    ids=["two lattices", "nothing shared", "both kinds", "planar", "one", "three"],
)
def test_the_very_same_numbers_arrive(kernels: KernelSet) -> None:
    assert_same(sent(kernels), kernels)


def test_what_is_shared_is_said_once() -> None:
    coded = code_kernels(BOTH, SPACINGS)
    assert coded.kinds.shape == [5, 2]
    assert coded.cells.shape == [3, len(BOTH)]
    assert coded.cells.dtype is messages.DType.UINT8
    assert coded.hinge_mean.shape == [3, 0]
    assert n_bytes(coded) < 11 * len(BOTH)  # plain, it is 40 bytes a kernel


def test_kernels_that_share_nothing_are_sent_as_they_are() -> None:
    coded = code_kernels(free_kernels(200), SPACINGS)
    assert coded.kind is None
    assert coded.kinds.shape == [5, 200]
    assert coded.hinge_mean.shape == [3, 200]
    assert n_bytes(coded) < 40 * 200 + 7 * 20  # no more than plain, but for the frames of the streams


def test_hinges_just_off_the_lattice_are_not_forced_onto_it() -> None:
    kernels = lattice_kernels(50)
    moved = kernels.hinge_mean.copy()
    moved[7, 1] = np.nextafter(np.float32(moved[7, 1]), np.float32(99))
    kernels = kernels.replace(hinge_mean=moved)
    assert code_kernels(kernels, SPACINGS).hinge_mean.shape == [3, len(kernels)]
    assert_same(sent(kernels), kernels)


def test_kernels_a_tile_beyond_the_corner_are_on_the_lattice_too() -> None:
    """Rounding may leave a kernel just outside its tile."""
    kernels = lattice_kernels(60).moved(np.array([-GRID.fine_m, 0.0, 0.0]))
    coded = code_kernels(kernels, SPACINGS)
    assert coded.cells.dtype is messages.DType.INT64
    assert_same(sent(kernels), kernels)


def test_minus_zero_is_not_zero() -> None:
    kernels = lattice_kernels(60)
    var = np.zeros((len(kernels), 3), np.float32)
    var[::2] = -0.0
    kernels = kernels.replace(hinge_var=var, weight_mean=np.full(len(kernels), -0.0, np.float32))
    assert code_kernels(kernels, SPACINGS).kinds.shape == [5, 2]
    assert_same(sent(kernels), kernels)


def test_hinges_far_beyond_any_tile_are_sent_as_they_are() -> None:
    kernels = lattice_kernels(60)
    kernels = kernels.replace(hinge_mean=kernels.hinge_mean * 1e12)
    assert code_kernels(kernels, SPACINGS).hinge_mean.shape == [3, len(kernels)]
    assert_same(sent(kernels), kernels)


def test_a_tile_at_utm_coordinates_loses_nothing() -> None:
    index = (62_500, 675_000, 1)  # 500 km east, 5,400 km north
    arrived = sent(BOTH, index)
    there = BOTH.hinge_mean.astype(np.float32).astype(np.float64) + np.array(index) * GRID.size_m
    np.testing.assert_array_equal(arrived.hinge_mean, there)


def received_array(of: messages.Array) -> np.ndarray:
    return wire.decode_array(of, "array", dtypes=tuple(DType), shape=(None,) * len(of.shape))


@pytest.mark.parametrize("at", [0.0, 5.3e6])
def test_kernels_travel_as_float32_about_a_float64_origin(at: float) -> None:
    sent = free_kernels(50).moved(np.full(3, at))
    received = encode_kernels(sent, RULE)
    assert received.origin == np.round(sent.hinge_mean.mean(axis=0)).tolist()
    hinges = np.asarray(received.origin) + received_array(received.hinge_mean)
    np.testing.assert_allclose(hinges, sent.hinge_mean, atol=2e-6, rtol=0)
    for name in ("hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        np.testing.assert_array_equal(received_array(getattr(received, name)), getattr(sent, name))


def test_no_kernels_are_a_message_too() -> None:
    received = encode_kernels(KernelSet.empty(), RULE)
    assert received.origin == [0.0, 0.0, 0.0]
    assert received.hinge_mean.shape == [0, 3]


# --- a scan's own map -------------------------------------------------------------------------------------------------


def own_map(planar: bool) -> OwnMap:
    """Kernels on both lattices, somewhere in the world."""
    parts = [
        lattice_kernels(300, spacing_m=GRID.coarse_m, planar=planar),
        lattice_kernels(500, 1, planar=planar),
    ]
    distinct = [part.take(np.unique(part.hinge_mean, axis=0, return_index=True)[1]) for part in parts]
    nodes = np.full((3, 3, 5), 128, np.uint8)
    nodes[..., 0] = 200
    return OwnMap(
        kernels=KernelSet.concatenate(distinct),
        origin=np.array([691_608.25, 5_335_799.5, 480.0]),
        spacings_m=SPACINGS,
        size_m=GRID.size_m,
        lean=LeanTiles(10.0, {(69_160, 533_579, 48): nodes}),
    )


def by_place(hinge: np.ndarray) -> np.ndarray:
    return np.lexsort(hinge.T)


@pytest.mark.parametrize("planar", [False, True], ids=["3d", "2d"])
def test_fitted_kernels_travel_as_nodes_in_whole_steps(planar: bool) -> None:
    own = own_map(planar)
    payload = wire.encode(encode_own_map(own, RULE))
    assert len(payload) < 8 * len(own.kernels), "ten numbers a kernel are 40 bytes"
    told = wire.decode(payload, messages.Kernels)
    assert told.hinge_mean.shape == [0, 3], "all stand on lattices"
    arrived = ClientKernels.from_message(told)
    assert arrived.rule == RULE
    local = arrived.hinge_mean - own.origin
    one, other = by_place(local.round(6)), by_place(own.kernels.hinge_mean.round(6))
    np.testing.assert_allclose(local[one], own.kernels.hinge_mean[other], atol=1e-6)
    for name in ("hinge_var", "gamma_shape", "gamma_rate"):
        np.testing.assert_array_equal(getattr(arrived, name)[one], getattr(own.kernels, name)[other])
    assert np.abs(arrived.weight_mean[one] - own.kernels.weight_mean[other]).max() <= 0.125 + 1e-6
    ratio = np.log(arrived.weight_var[one] / own.kernels.weight_var[other])
    assert np.abs(ratio).max() <= 0.375 + 1e-6
    assert own.lean is not None
    assert arrived.lean is not None
    np.testing.assert_array_equal(
        arrived.lean.nodes[69_160, 533_579, 48], own.lean.nodes[69_160, 533_579, 48]
    )


def test_carried_kernels_travel_as_they_are() -> None:
    own = OwnMap(kernels=free_kernels(20), origin=np.array([100.0, 0.0, 0.0]))
    told = encode_own_map(own, RULE)
    assert told.nodes is messages.ABSENT
    assert told.lean is messages.ABSENT
    arrived = ClientKernels.from_message(told)
    np.testing.assert_array_equal(arrived.hinge_mean, own.kernels.hinge_mean.astype(np.float32) + own.origin)
    np.testing.assert_array_equal(arrived.weight_mean, own.kernels.weight_mean)


def test_nodes_that_do_not_fit_are_a_bad_reply() -> None:
    told = encode_own_map(own_map(False), RULE)
    assert told.nodes is not messages.ABSENT
    based = msgspec.structs.replace(told.nodes, based=wire.pack_array(np.array([True])))
    two = msgspec.structs.replace(told.nodes, based=wire.pack_array(np.zeros(2, np.bool_)))
    for nodes in (based, two):
        with pytest.raises(BadReplyError):
            ClientKernels.from_message(msgspec.structs.replace(told, nodes=nodes))
