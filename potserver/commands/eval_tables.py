"""The tables of `potserver eval`: a line a map, the same for the terminal and for documents."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from potclient.metrics import Metrics
    from potserver.evaluation.faces import Crossings
    from potserver.evaluation.protocol import Evaluation, Row
    from potserver.evaluation.questions import BeamScores
    from potserver.evaluation.truth import VolumeScores

_METRICS = ("ACC", "AUC", "NLL", "Brier", "ECE", "unknown")


class Table(NamedTuple):
    """One table; all lines have as many cells as there are heads."""

    name: str
    heads: list[str]
    lines: list[list[str]]


def tables_of(evaluation: Evaluation) -> Iterator[Table]:
    """Size and time, beams, near, rings, rays, truth, faces, openings, and protocol 1: those that the dataset has."""
    scores = evaluation.rows[0].scores
    yield _table("size and time", ["kernels", "bytes", "ms/scan", "[range]", "CPU ms"], _cost, evaluation)
    yield _table("beams", [*_METRICS, "H", "N", "(H + N) / 2"], _beams, evaluation)
    if scores.beams.near is not None:
        yield _table("near", _near_heads(scores.beams), lambda row: _near(row.scores.beams), evaluation)
    if scores.rings is not None:
        yield _rings(evaluation)
    if any(row.scores.rays is not None for row in evaluation.rows):
        yield _table("rays", ["P(return) of beams without one", "range error, m"], _rays, evaluation)
    if scores.truth is not None:
        heads = [f"{volume}: {head}" for volume in ("uniform", "ball") for head in ("NLL", "wrong")]
        heads += ["> .9 is occupied", "< .1 is free", "unseen: observed", "sure"]
        yield _table("truth", [*heads, "squared error / variance, by sd"], _truth, evaluation)
    if scores.faces is not None:
        faces = [*scores.faces.upright_by_range, *scores.faces.upright_by_incidence]
        heads = ["upright: median / p95", "early", "missed", *faces, "level: median / p95"]
        yield _table("faces, cm before the truth", heads, _faces, evaluation)
    if scores.openings is not None:
        yield from _openings(evaluation)
    yield _protocol_1(evaluation)


def _table(name: str, heads: list[str], cells: Callable[[Row], list[str]], evaluation: Evaluation) -> Table:
    return Table(name, ["map", *heads], [[row.name, *cells(row)] for row in evaluation.rows])


def _cost(row: Row) -> list[str]:
    spread = "batch" if row.is_batch else f"[{min(row.scan_ms):.0f}-{max(row.scan_ms):.0f}]"
    times = [f"{np.median(row.scan_ms):.0f}", spread, f"{np.median(row.cpu_ms):.0f}"]
    return [f"{row.size.cells:,}", f"{row.size.n_bytes:,}", *times]


def _metrics(m: Metrics) -> list[str]:
    scores = [f"{m.accuracy:.3f}", f"{m.auc:.4f}", f"{m.nll:.3f}", f"{m.brier:.3f}", f"{m.ece:.3f}"]
    return [*scores, f"{m.share_unknown:.1%}"]


def _beams(row: Row) -> list[str]:
    scores = row.scores
    near = float("nan") if scores.beams.near is None else scores.beams.near.nll
    last = (scores.protocol_1.held_out.nll, near, scores.headline)
    return [*_metrics(scores.beams.metrics), *(_number(value, 3) for value in last)]


def _near_heads(beams: BeamScores) -> list[str]:
    assert beams.near is not None
    spans = [f"{100 * found.from_m:.0f}-{100 * found.to_m:.0f} cm" for found in beams.near.bins]
    return ["N", "AUC", "ends: NLL, p", *(f"{span}: NLL, p" for span in spans)]


def _near(beams: BeamScores) -> list[str]:
    near = beams.near
    assert near is not None
    cells = [f"{found.nll:.2f}, {found.mean:.2f}" for found in (near.ends, *near.bins)]
    return [f"{near.nll:.3f}", f"{near.auc:.4f}", *cells]


def _rings(evaluation: Evaluation) -> Table:
    lines = []
    for row in evaluation.rows:
        rings = row.scores.rings
        assert rings is not None
        near = float("nan") if rings.near is None else rings.near.nll
        lines.append([row.name, *_metrics(rings.metrics), _number(near, 3)])
    return Table("beams of rings left out", ["map", *_METRICS, "N"], lines)


def _rays(row: Row) -> list[str]:
    rays = row.scores.rays
    return ["-", "-"] if rays is None else [_number(rays.false_return), _number(rays.range_error_m)]


def _truth(row: Row) -> list[str]:
    truth = row.scores.truth
    assert truth is not None

    def volume(found: VolumeScores) -> list[str]:
        return [_number(found.metrics.nll, 3), f"{found.wrong:.1%}"]

    uniform = truth.uniform
    shares = (
        uniform.called_occupied_true, uniform.called_free_true, uniform.unseen_observed, uniform.unseen_sure,
    )  # fmt: skip
    sd = " ".join(_number(found.brier / max(found.rms_sd**2, 1e-9), 1) for found in truth.sd) or "-"
    return [*volume(uniform), *volume(truth.ball), *(_share(share) for share in shares), sd]


def _faces(row: Row) -> list[str]:
    faces = row.scores.faces
    assert faces is not None

    def spread(found: Crossings) -> str:
        return f"{_number(found.median_cm, 0)} / {_number(found.p95_cm, 0)}"

    parts = [*faces.upright_by_range.values(), *faces.upright_by_incidence.values()]
    upright = [spread(faces.upright), _share(faces.upright.early), _share(faces.upright.missed)]
    return [*upright, *(spread(found) for found in parts), spread(faces.level)]


def _openings(evaluation: Evaluation) -> Iterator[Table]:
    first = evaluation.rows[0].scores.openings
    assert first is not None
    found = [(row.name, row.scores.openings) for row in evaluation.rows if row.scores.openings is not None]
    yield Table(
        "openings: m left at p < .5 / < .2",
        ["map", *(f"{o.width_m:g} m, {o.away_m:g} m away" for o in first.openings)],
        [[name, *(f"{o.free_m:.2f} / {o.safe_m:.2f}" for o in scores.openings)] for name, scores in found],
    )
    things = [f"{100 * t.diameter_m:g} cm pole, {t.away_m:g} m away" for t in first.poles]
    things += [f"{100 * t.diameter_m:g} cm wire" for t in first.wires]
    yield Table(
        "thin things: share kept, and of poles the width, cm",
        ["map", *things],
        [
            [
                name,
                *(f"{t.kept:.0%}, {_number(100 * t.width_m, 0)}" for t in scores.poles),
                *(f"{t.kept:.0%}" for t in scores.wires),
            ]
            for name, scores in found
        ],
    )


def _protocol_1(evaluation: Evaluation) -> Table:
    volumes = list(evaluation.rows[0].scores.protocol_1.truth)
    heads = ["map", *_METRICS]
    for volume in volumes:
        heads += [f"{volume.replace('_', ' ')}: ACC", "AUC", "NLL", "unknown"]
    lines = []
    for row in evaluation.rows:
        scores = row.scores.protocol_1
        cells = [row.name, *_metrics(scores.held_out)]
        for volume in volumes:
            m = scores.truth[volume]
            cells += [f"{m.accuracy:.3f}", f"{m.auc:.4f}", f"{m.nll:.3f}", f"{m.share_unknown:.1%}"]
        lines.append(cells)
    return Table("protocol 1: free points at least 0.5 m before the ends", heads, lines)


def _number(value: float, digits: int = 2) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def _share(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.1%}"
