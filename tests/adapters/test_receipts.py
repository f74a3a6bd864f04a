"""Receipts and what goes with them, as messages."""

from __future__ import annotations

import numpy as np

from potschemas import messages, wire
from potschemas.answers import AnswerRule
from potschemas.messages import ReceiptStatus
from potserver import errors
from potserver.adapters.receipts import Waited, encode_accepted, encode_params, encode_revision, refusal
from potserver.domain.types import MapUpdate, Scan, SectorMatch, TileChange
from potserver.mapping.pipeline import ScanMap
from tests.tiled_maps import free_kernels

RULE = AnswerRule(observed_activation=0.05, prior_var=50.0, residual_var=20.0, mean_moderation=0.25)


def test_load_and_shutdown_drop_a_cloud_and_everything_else_rejects_it() -> None:
    assert refusal(errors.OverloadedError("")) is ReceiptStatus.DROPPED
    assert refusal(errors.ShuttingDownError("")) is ReceiptStatus.DROPPED
    assert refusal(errors.BadPoseError("")) is ReceiptStatus.REJECTED


def update_of(*sectors: SectorMatch) -> MapUpdate:
    return MapUpdate(
        map_revision=1,
        own=ScanMap(list(sectors), free_kernels(4), free_kernels(4), True).told,
        n_points=5,
        n_kernels_added=4,
        n_kernels_transported=3,
        converged=True,
        rule=RULE,
        map_kernels=4,
        changed=TileChange(10.0, [(np.int64(-1), np.int64(2), np.int64(0))]),  # type: ignore[list-item]
        timings_ms={},
    )


SCAN = Scan(points=np.ones((5, 3), np.float32), T_map_sensor=np.eye(4), robot_id="r1", seq=4)


def test_a_sector_without_an_atom_still_travels() -> None:
    sector = SectorMatch(
        0.0, 1.0, 3, 4, None, 0.0, float("inf"), 0, False, float("nan"), 0, "no atom is comparable"
    )
    update = update_of(sector)
    sent = encode_params("m", SCAN, update)
    (report,) = wire.decode(sent.payload, messages.Params).sectors
    assert (report.atom_id, report.reason, report.n_hits) == (None, "no atom is comparable", 3)
    tick = encode_revision("m", 3, 9, changed=update.changed, stamp_ns=9)
    assert wire.decode(tick.payload, messages.Revision).changed_tiles == [[-1, 2, 0]]


def test_kernels_leave_with_the_rule_of_their_own_update() -> None:
    wires = (
        encode_params("m", SCAN, update_of()),
        encode_accepted("m", SCAN, update_of(), Waited(2, 3.0), 4.0, with_kernels=True),
    )
    for sent, kind in zip(wires, (messages.Params, messages.Receipt), strict=True):
        kernels = wire.decode(sent.payload, kind).kernels
        assert kernels is not None
        assert (kernels.residual_var, kernels.mean_moderation) == (20.0, 0.25)
