"""RePOT takes all that was carried, with its weights as prior, and learns from the labels."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from potclient.datasets import open_dataset
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import score
from potserver import MappingService, MappingSettings
from potserver.domain.tiles import CARRIED
from potserver.evaluation.mappers import ServiceMap
from potserver.evaluation.repot import FlatRePotPipeline, RePotPipeline
from potserver.mapping.paper import PAPER, PotPipeline
from potserver.recordings import to_scan

PIPELINES = {
    "POT": partial(PotPipeline, method=PAPER),
    "RePOT": RePotPipeline,
    "flat": FlatRePotPipeline,
}


@pytest.fixture(scope="module")
def maps() -> tuple[dict[str, MappingService], list, LabelledPoints]:
    """Three maps of a few scans in a suburb, 2D, with the updates of RePOT and beams that none was given."""
    recording = open_dataset("town:suburb:2d:7", max_range_m=20.0)
    paper, hold_out = MappingSettings.of_profile("paper"), HoldOut()
    made = {
        name: MappingService(settings=paper, threads=2, make_pipeline=pipeline)
        for name, pipeline in PIPELINES.items()
    }
    updates, labels = [], []
    for number in range(0, 40, 10):
        given, kept_back = hold_out.split(recording[number], number)
        labels.append(kept_back)
        found = {name: service.integrate(to_scan(given, number)) for name, service in made.items()}
        updates.append(found)
    return made, updates, LabelledPoints.concatenate(labels)


def test_nothing_that_was_carried_is_left_out(maps) -> None:
    made, updates, _ = maps
    for found in updates:
        carried = sum(sector.n_kernels for sector in found["RePOT"].sectors)
        assert found["RePOT"].n_kernels_transported == found["RePOT"].n_kernels_added == carried > 300
    assert len(made["RePOT"].snapshot) == len(made["POT"].snapshot) == updates[-1]["POT"].map_kernels
    levels = [tile.kernels.level for tile in made["RePOT"].state.tiled.tiles.values()]
    assert set(np.concatenate(levels).tolist()) == {CARRIED}


def test_the_prior_is_what_was_carried(maps) -> None:
    made, _, _ = maps

    def weights(name: str, field: str) -> np.ndarray:
        tiles = made[name].state.tiled.tiles.values()
        return np.sort(np.concatenate([getattr(tile.kernels, field) for tile in tiles]))

    for field in ("prior_mean", "prior_var"):
        np.testing.assert_allclose(weights("RePOT", field), weights("POT", field), rtol=1e-5)
    np.testing.assert_array_equal(weights("flat", "prior_mean"), 0.0)
    solved = made["RePOT"].snapshot.kernels
    assert np.abs(np.sort(solved.weight_mean) - weights("RePOT", "prior_mean")).max() > 1.0
    assert solved.weight_var.mean() < weights("RePOT", "prior_var").mean()


def test_labels_make_it_better_and_the_prior_matters(maps) -> None:
    made, _, labels = maps
    found = {}
    for name, service in made.items():
        answer = ServiceMap(name, service).ask(labels.points)
        found[name] = score(answer.mean, labels.occupied, answer.observed)
    assert found["RePOT"].auc > found["POT"].auc + 0.05
    assert found["RePOT"].nll < 0.5 * found["POT"].nll
    assert abs(found["RePOT"].nll - found["flat"].nll) > 0.01


def test_the_senders_own_map_is_refined_too(maps) -> None:
    _, updates, _ = maps
    raw, refined = updates[0]["POT"].kernels, updates[0]["RePOT"].kernels
    np.testing.assert_array_equal(raw.hinge_mean, refined.hinge_mean)
    assert np.abs(raw.weight_mean - refined.weight_mean).max() > 1.0
