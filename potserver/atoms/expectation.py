"""What a dictionary's recordings teach to expect about a scan: learned from thin looks, asked about all other beams.

Scans are thinned to few beams or few rings, and the net learns to tell what the rest of their beams met, and beams of the scans
after them, which look behind things. Each time the scene is varied, so that what is made up teaches about what is real. A map
keeps what it expects on a lattice, so the net is fitted through one: what it says at the eight nodes about a place is
interpolated there as a map does it, with the lattice turned and shifted at random.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from potserver.atoms.variation import AS_IT_IS, Variation, draw_variation
from potserver.domain.tiles import LEAN_LEVEL_M, LEAN_M
from potserver.domain.types import Bool, Float32, Float64, Scan
from potserver.numerics.abhm.dispersions import one_torch_thread
from potserver.numerics.beams import Beams, cut_range, label_beams, limit_range
from potserver.numerics.ground import LEAST_GROUND, LOWEST_EYE_M, Ground, ground_of
from potserver.numerics.surroundings import FORMER_FEATURES, N_FEATURES, Perceptron, Surroundings

_SHARES = (1, 4, 4, 16, 64, 256, 256, 1024, 1024)  # one beam of so many is seen
_RINGS = (4, 8, 16, 32)  # or so many rings
_RING_RAD = np.radians(0.2)  # beams whose elevations round to the same multiple belong to one
_SEEN = 30_000  # beams, at most
_ASKED = 180  # beams of each scan that are asked about
_LATER = 2  # scans that are asked about too
_GAP_M = 0.05  # before a hit, where nothing is free: the noise of a range
# The ground of few hits is not that of all: a plane is told wrong by so much (standard deviations).
_OFF_M, _OFF_SLOPE = 0.02, 0.002
_WIDTHS = (48, 32)
_DIGITS = 4  # kept of a weight behind the point
_EPOCHS, _BATCH, _LEARNING_RATE = 12, 1024, 0.01
_EPOCHS_OF_MORE, _RATE_OF_MORE = 5, 0.003  # of a net that goes on
_WITHOUT_LINES = 0.4  # of the places: real ones stand less in lines than made-up streets
_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))


class _Lesson(NamedTuple):
    """N labelled places, each seen through the nodes about it."""

    features: Float32  # (N, 8, N_FEATURES)
    shares: Float32  # (N, 8) of the nodes
    occupied: Bool  # (N,)


def learn_expectation(
    recordings: Iterable[Iterable[Scan]], *, max_range_m: float, seed: int
) -> Perceptron | None:
    """What scans with few beams tell of all the others; None if no recording has a ground and a sensor above it.

    Args:
        recordings: Some scans of each, in order; planar ones are left out.
        max_range_m: Longer beams are cut.
        seed: Of all draws.
    """
    lesson = _lesson_of_all(recordings, max_range_m, seed, vary=True)
    if lesson is None:
        return None
    with one_torch_thread():
        return _fit(lesson, seed)


class Further(NamedTuple):
    """A net that learned more."""

    net: Perceptron
    nll: float  # of labels that it was not told, nats
    nll_before: float  # of the best of the nets that were known, on the same ones; ln 2 if there were none
    n_places: int  # labels that it was told


def learn_further(
    known: Sequence[Perceptron],
    scans: Sequence[Scan],
    held_out: Sequence[Scan],
    *,
    max_range_m: float,
    seed: int,
) -> Further | None:
    """What scans of one place add to what is known; None if they tell nothing, see `learn_expectation`.

    Args:
        known: The net that foretells the held-out scans best goes on learning.
        scans: To learn from, in order.
        held_out: To judge by, in order.
        max_range_m, seed: As there.
    """
    told, asked = (_lesson_of_all([some], max_range_m, seed, vary=False) for some in (scans, held_out))
    if told is None or asked is None:
        return None
    with one_torch_thread():
        before = [_nll(_module(net), asked) for net in known]
        net = _fit(told, seed, known[int(np.argmin(before))] if known else None)
        nll = _nll(_module(net), asked)
    return Further(net, nll, min(before, default=float(np.log(2.0))), len(told.occupied))


def _lesson_of_all(
    recordings: Iterable[Iterable[Scan]], max_range_m: float, seed: int, *, vary: bool
) -> _Lesson | None:
    """All looks together; those at a place itself are not varied."""
    rng = np.random.default_rng(seed)
    lessons: list[_Lesson] = []
    for scans in recordings:
        upright = [scan for scan in scans if not scan.is_planar]
        beams = [limit_range(scan.beams, 0.0, max_range_m) for scan in upright]
        for i, scan in enumerate(upright):
            after = slice(i + 1, i + 1 + _LATER)
            later = [
                (Beams(b.ends + s.origin - scan.origin, b.is_return), s.origin - scan.origin)
                for b, s in zip(beams[after], upright[after], strict=True)
            ]
            lessons += _lessons_of(beams[i], later, max_range_m, rng, vary=vary)
    return _Lesson(*(np.concatenate(columns) for columns in zip(*lessons, strict=True))) if lessons else None


def _lessons_of(
    beams: Beams, later: list[tuple[Beams, Float64]], reach_m: float, rng: np.random.Generator, *, vary: bool
) -> list[_Lesson]:
    """One of each way to thin a scan.

    Args:
        beams: Relative to the sensor.
        later: Beams of other scans, their ends relative to the same place, and (3,) m where they start.
        reach_m: Farther places are not asked about.
        rng: Of the draws.
        vary: Each in another scene.
    """
    n = len(beams.ends)
    chosen = [rng.permutation(n) < max(n // share, 1) for share in _SHARES]
    chosen += [_in_rings(beams.ends, rings) for rings in _RINGS]
    out = []
    for seen in chosen:
        scene = draw_variation(rng) if vary else AS_IT_IS
        drawn = rng.permutation(np.flatnonzero(seen))[:_SEEN]
        view, _ = scene.seen(beams.take(drawn), np.zeros(3), rng)
        view = cut_range(view, reach_m)
        view = view._replace(ends=scene.lifted(view.ends))
        hits = view.ends[view.is_return]
        if len(hits) < LEAST_GROUND:
            continue
        ground = ground_of(hits)
        if -ground.height_m < LOWEST_EYE_M:
            continue
        others = [(beams.take(~seen), np.zeros(3)), *later]
        places = [_places(asked, eye, scene, rng) for asked, eye in others if len(asked.ends)]
        if not places:
            continue
        points, occupied = (np.concatenate(columns) for columns in zip(*places, strict=True))
        near = np.linalg.norm(points, axis=1) < reach_m
        if near.any():
            out.append(
                _lesson(Surroundings.of(view, _misjudged(ground, rng)), points[near], occupied[near], rng)
            )
    return out


def _misjudged(ground: Ground, rng: np.random.Generator) -> Ground:
    up, along_x, along_y = rng.normal(0.0, (_OFF_M, _OFF_SLOPE, _OFF_SLOPE))
    return ground._replace(
        height_m=ground.height_m + up, slope_x=ground.slope_x + along_x, slope_y=ground.slope_y + along_y
    )


def _in_rings(ends: Float64, wanted: int) -> Bool:
    """(N,) which beams lie in some rings, about evenly spread over all."""
    elevation = np.arctan2(ends[:, 2], np.hypot(ends[:, 0], ends[:, 1]))
    found, ring = np.unique(np.rint(elevation / _RING_RAD), return_inverse=True)
    every = max(len(found) // wanted, 1)
    return np.asarray(ring.reshape(-1) % every == every // 2)


def _places(beams: Beams, eye: Float64, scene: Variation, rng: np.random.Generator) -> tuple[Float64, Bool]:
    """Labelled places in a scene, on some beams that start at `eye`, (3,) m."""
    drawn = rng.permutation(len(beams.ends))[:_ASKED]
    about, eye = scene.seen(beams.take(drawn), eye, rng)
    labelled = label_beams(about._replace(ends=about.ends - eye), free_per_beam=1, gap_m=_GAP_M, rng=rng)
    return scene.lifted(labelled.points + eye), labelled.occupied


def _lesson(view: Surroundings, points: Float64, occupied: Bool, rng: np.random.Generator) -> _Lesson:
    """Places through the nodes of a lattice that lies anyhow."""
    turn = rng.uniform(0, np.pi / 2)
    spacing = np.array([LEAN_M, LEAN_M, LEAN_LEVEL_M])
    to_lattice = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    placed = points @ to_lattice.T / spacing + rng.random(3)
    shift = placed[:1] - points[:1] @ to_lattice.T / spacing
    corner = np.floor(placed)
    along = placed - corner
    nodes = (corner[:, None] + _CORNERS - shift) * spacing @ to_lattice
    shares = np.where(_CORNERS == 1, along[:, None], 1 - along[:, None]).prod(axis=2)
    features = view.features(np.ascontiguousarray(nodes.reshape(-1, 3))).reshape(-1, 8, N_FEATURES)
    features[rng.random(len(points)) < _WITHOUT_LINES, :, FORMER_FEATURES:] = 0.0
    return _Lesson(features.astype(np.float16), shares.astype(np.float32), occupied)


def _fit(lesson: _Lesson, seed: int, start: Perceptron | None = None) -> Perceptron:
    torch.manual_seed(seed)
    net = _module(start)
    features, shares = torch.from_numpy(lesson.features), torch.from_numpy(lesson.shares)
    occupied = torch.from_numpy(lesson.occupied.astype(np.float32))
    epochs, rate = (_EPOCHS, _LEARNING_RATE) if start is None else (_EPOCHS_OF_MORE, _RATE_OF_MORE)
    n_steps = epochs * -(-len(occupied) // _BATCH)
    optimizer = torch.optim.Adam(net.parameters())
    pace = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=n_steps)
    loss = torch.nn.BCEWithLogitsLoss()
    for _ in range(epochs):
        for batch in torch.randperm(len(occupied)).split(_BATCH):
            optimizer.zero_grad()
            loss(_log_odds(net, features[batch], shares[batch]), occupied[batch]).backward()
            optimizer.step()
            pace.step()
    linear = [layer for layer in net if isinstance(layer, torch.nn.Linear)]
    (w1, b1), (w2, b2), (w3, b3) = (
        (layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in linear
    )
    layers = (w1, b1, w2, b2, w3[:, 0], b3)
    return Perceptron(*(np.ascontiguousarray(x.round(_DIGITS), np.float32) for x in layers))


def _module(start: Perceptron | None) -> torch.nn.Sequential:
    """A net of torch: with these weights, or with random ones."""
    a, b = _WIDTHS if start is None else (len(start.first_bias), len(start.second_bias))
    net = torch.nn.Sequential(
        torch.nn.Linear(N_FEATURES, a), torch.nn.ReLU(), torch.nn.Linear(a, b), torch.nn.ReLU(), torch.nn.Linear(b, 1)
    )  # fmt: skip
    if start is not None:
        layers = (
            start.first.T,
            start.first_bias,
            start.second.T,
            start.second_bias,
            start.last[None],
            start.last_bias,
        )
        with torch.no_grad():
            for parameter, values in zip(net.parameters(), layers, strict=True):
                parameter.copy_(torch.from_numpy(np.array(values)))
    return net


def _log_odds(net: torch.nn.Module, features: torch.Tensor, shares: torch.Tensor) -> torch.Tensor:
    """(N,) interpolated between the nodes."""
    return (net(features.float())[..., 0] * shares).sum(dim=1)


def _nll(net: torch.nn.Module, lesson: _Lesson) -> float:
    occupied = torch.from_numpy(lesson.occupied.astype(np.float32))
    with torch.no_grad():
        log_odds = _log_odds(net, torch.from_numpy(lesson.features), torch.from_numpy(lesson.shares))
    return float(torch.nn.functional.binary_cross_entropy_with_logits(log_odds, occupied))
