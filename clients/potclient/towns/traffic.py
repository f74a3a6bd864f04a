"""What moves in a dynamic town: cars (indoors: people) in the lanes, and parked cars that leave."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.towns.site import Name, Parked
from potclient.towns.solids import Part, placed
from potclient.towns.streets import Drive, StreetGrid, stream
from potclient.towns.styles import Style
from potclient.towns.things import Mover, person, vehicle

_NEAR_M = 110.0  # only what comes this near to the drive exists
_STEP_S = 0.2  # at which collisions are looked for
_ACCELERATION = 2.0  # m/s^2, of a car that leaves
_PULL_OUT_M = 9.0  # travel until it is in its lane
_GAP_M = (0.6, 0.15)  # kept ahead and aside


class Traffic:
    """Everything that moves while a drive lasts; nothing in it ever touches the sensor's own vehicle.

    Each mover goes along a straight street at a constant speed. One with a `start_s` is parked until then, pulls out into its
    lane and gathers that speed.
    """

    def __init__(self, style: Style) -> None:
        self.style = style
        self.movers: list[Mover] = []
        self.base: Float64 = np.zeros((0, 2))  # m, where it is at time 0, or parked
        self.unit: Float64 = np.zeros((0, 2))  # direction of travel
        self.speed_m_s: Float64 = np.zeros(0)
        self.start_s: Float64 = np.zeros(0)  # -inf: always moving
        self.aside_m: Float64 = np.zeros(0)  # how far left of `base` the lane is
        self.askew_rad: Float64 = np.zeros(0)  # of the heading while parked

    def __len__(self) -> int:
        return len(self.movers)

    def add(
        self,
        movers: list[Mover],
        base: Float64,
        unit: Float64,
        speed_m_s: Float64,
        start_s: Float64,
        aside_m: Float64,
        askew_rad: Float64,
    ) -> None:
        """More movers."""
        self.movers = self.movers + movers
        self.base, self.unit = np.concatenate([self.base, base]), np.concatenate([self.unit, unit])
        self.speed_m_s = np.concatenate([self.speed_m_s, speed_m_s])
        self.start_s = np.concatenate([self.start_s, start_s])
        self.aside_m = np.concatenate([self.aside_m, aside_m])
        self.askew_rad = np.concatenate([self.askew_rad, askew_rad])

    def keep(self, chosen: Bool) -> None:
        """Only some of them."""
        rows = np.arange(len(self))[chosen]
        self.movers = [self.movers[k] for k in rows]
        for name in ("base", "unit", "speed_m_s", "start_s", "aside_m", "askew_rad"):
            setattr(self, name, getattr(self, name)[rows])

    def poses(self, times_s: Float64) -> Float64:
        """(T, M, 3) x m, y m, yaw rad of all movers at times (T,)."""
        always = np.isneginf(self.start_s)
        time = np.asarray(times_s, np.float64)[:, None]
        since = np.maximum(time - np.where(always, 0.0, self.start_s), 0.0)
        rising = np.minimum(since, self.speed_m_s / _ACCELERATION)
        pulled_out = 0.5 * _ACCELERATION * rising**2 + self.speed_m_s * (since - rising)
        travelled = np.where(always, self.speed_m_s * time, pulled_out)
        share = np.clip(travelled / _PULL_OUT_M, 0.0, 1.0)
        eased = share**2 * (3 - 2 * share)
        steer = np.arctan(self.aside_m * 6 * share * (1 - share) / _PULL_OUT_M)
        (ux, uy), aside = self.unit.T, self.aside_m * eased
        return np.stack(
            [
                self.base[:, 0] + travelled * ux - aside * uy,
                self.base[:, 1] + travelled * uy + aside * ux,
                np.arctan2(uy, ux) + steer + self.askew_rad * (1 - eased),
            ],
            axis=2,
        )

    def parts(self, time_s: float, lower: Float64, upper: Float64) -> list[Part]:
        """The solids of what is near a box (2,), (2,) m at a time."""
        if not len(self):
            return []
        poses = self.poses(np.array([time_s]))[0]
        near = ((poses[:, :2] > lower - 4.0) & (poses[:, :2] < upper + 4.0)).all(axis=1)
        return [part for k in np.flatnonzero(near) for part in placed(self.movers[k].parts, *poses[k])]

    @property
    def sizes_m(self) -> Float64:
        """(M, 2) length and width."""
        return np.array([(m.length_m, m.width_m) for m in self.movers]).reshape(-1, 2)


def plan_traffic(
    grid: StreetGrid, drive: Drive, parked: list[tuple[Name, Parked]]
) -> tuple[Traffic, set[Name]]:
    """The traffic of a drive, free of collisions with it, and the names of the parked cars that leave.

    Args:
        grid: The streets.
        drive: Driven at the style's speed from time 0 on.
        parked: Names and places of the parked cars that may leave.
    """
    style = grid.style
    traffic = Traffic(style)
    _fill_lanes(grid, drive, traffic)
    times = np.arange(0.0, drive.length_m / style.speed_m_s + _STEP_S, _STEP_S)
    ego = drive.at(np.minimum(times * style.speed_m_s, drive.length_m))
    _keep_near(traffic, times[::10], ego[::10])
    _clear_crossings(traffic)
    hit = np.zeros(len(traffic), np.bool_)
    for t, pose in _chunks(times, ego):
        hit |= _touch(traffic.poses(t), traffic.sizes_m, pose[:, None], style.body_m).any(axis=0)
    traffic.keep(~hit)
    return traffic, _let_leave(grid, traffic, parked, times, ego)


def _fill_lanes(grid: StreetGrid, drive: Drive, traffic: Traffic) -> None:
    style = grid.style
    seconds = drive.length_m / style.speed_m_s
    track = drive.at(np.arange(0.0, drive.length_m + 1.0, 1.0))[:, :2]
    lower, upper = track.min(axis=0) - _NEAR_M, track.max(axis=0) + _NEAR_M
    low, high = grid.cell(lower[None])[0], grid.cell(upper[None])[0] + 1
    indoors = style.ceiling_m is not None
    movers: list[Mover] = []
    base, unit, speeds = [], [], []
    for axis in (0, 1):
        for k in range(int(low[axis]), int(high[axis]) + 1):
            for way in (1, -1):
                speed = _lane_speed_m_s(grid, axis, k, way)
                # axis 0 runs north (along y); one drives on the right
                along = 1 - axis
                right = way if axis == 0 else -way
                offset = 0.45 if indoors else grid.lane_m(axis, k)
                across = grid.street(axis, k).center_m + right * offset
                begin = lower[along] - (seconds * speed if way > 0 else 0.0)
                end = upper[along] + (seconds * speed if way < 0 else 0.0)
                gap = style.traffic_gap_m
                for slot in range(math.floor(begin / gap), math.ceil(end / gap)):
                    slot_rng = stream(grid.seed, 5, axis, k, way, slot)
                    if slot_rng.random() > 0.75:
                        continue
                    where = gap * (slot + slot_rng.uniform(0.0, 0.6))
                    movers.append(person(slot_rng) if indoors else vehicle(slot_rng, 0.12))
                    base.append((across, where) if axis == 0 else (where, across))
                    unit.append((0.0, float(way)) if axis == 0 else (float(way), 0.0))
                    speeds.append(speed)
    n = len(movers)
    traffic.add(
        movers,
        np.array(base).reshape(-1, 2),
        np.array(unit).reshape(-1, 2),
        np.array(speeds),
        np.full(n, -np.inf),
        np.zeros(n),
        np.zeros(n),
    )


def _lane_speed_m_s(grid: StreetGrid, axis: int, k: int, way: int) -> float:
    """All in one lane are equally fast, so that none runs into another."""
    return grid.style.traffic_m_s * float(stream(grid.seed, 4, axis, k, way).uniform(0.85, 1.15))


def _keep_near(traffic: Traffic, times: Float64, ego: Float64) -> None:
    nearest = np.full(len(traffic), np.inf)
    for t, pose in _chunks(times, ego):
        apart = traffic.poses(t)[:, :, :2] - pose[:, None, :2]
        nearest = np.minimum(nearest, np.hypot(apart[..., 0], apart[..., 1]).min(axis=0))
    traffic.keep(nearest < _NEAR_M)


def _clear_crossings(traffic: Traffic) -> None:
    """Takes out cars that would meet another one on a crossing."""
    north = np.flatnonzero(traffic.unit[:, 0] == 0)
    gone = np.zeros(len(traffic), np.bool_)
    reach = traffic.sizes_m.sum(axis=1) / 2 + 1.0
    for k in np.flatnonzero(traffic.unit[:, 1] == 0):
        x, y = traffic.base[north, 0], traffic.base[k, 1]
        there = (x - traffic.base[k, 0]) * traffic.unit[k, 0] / traffic.speed_m_s[k]
        theirs = (y - traffic.base[north, 1]) * traffic.unit[north, 1] / traffic.speed_m_s[north]
        needed = (reach[k] + reach[north]) / 2 * (1 / traffic.speed_m_s[k] + 1 / traffic.speed_m_s[north])
        gone[k] = bool((np.abs(there - theirs) < needed).any())
    traffic.keep(~gone)


def _touch(poses: Float64, sizes: Float64, other: Float64, size: tuple[float, float]) -> Bool:
    """Whether boxes at poses (..., 3) come too near to a box at `other` (..., 3), by their extents in its frame."""
    dx, dy = poses[..., 0] - other[..., 0], poses[..., 1] - other[..., 1]
    c, s = np.cos(other[..., 2]), np.sin(other[..., 2])
    turn = poses[..., 2] - other[..., 2]
    ct, st = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    long, wide = sizes[:, 0] / 2, sizes[:, 1] / 2
    ahead = np.abs(dx * c + dy * s) < ct * long + st * wide + size[0] / 2 + _GAP_M[0]
    aside = np.abs(dy * c - dx * s) < st * long + ct * wide + size[1] / 2 + _GAP_M[1]
    return np.asarray(ahead & aside, np.bool_)


def _chunks(times: Float64, ego: Float64) -> Iterator[tuple[Float64, Float64]]:
    for k in range(0, len(times), 200):
        yield times[k : k + 200], ego[k : k + 200]


def _let_leave(
    grid: StreetGrid, traffic: Traffic, parked: list[tuple[Name, Parked]], times: Float64, ego: Float64
) -> set[Name]:
    """Adds those parked cars that can leave without touching anything; the result is their names."""
    style, rng = grid.style, stream(grid.seed, 6)
    gone: set[Name] = set()
    for name, car in parked:
        distance = np.hypot(ego[:, 0] - car.x_m, ego[:, 1] - car.y_m)
        seen = int(distance.argmin())
        if distance[seen] > 40.0:
            continue
        heading = round(car.yaw_rad / (math.pi / 2)) * math.pi / 2
        unit = np.array([round(math.cos(heading)), round(math.sin(heading))], np.float64)
        axis = 0 if unit[0] == 0 else 1
        place = np.array([car.x_m, car.y_m])
        left = np.array([-unit[1], unit[0]])
        k = int(grid.cell(place[None])[0, axis])
        line = min(k, k + 1, key=lambda n: abs(grid.street(axis, n).center_m - place[axis]))
        lane = grid.street(axis, line).center_m - left[axis] * grid.lane_m(axis, line)
        speed = _lane_speed_m_s(grid, axis, line, int(unit[1 - axis]))
        for start in times[seen] + rng.uniform(-10.0, 8.0, 4):
            if start < 1.0:
                continue
            alone = Traffic(style)
            alone.add(
                [car.mover],
                base=place[None],
                unit=unit[None],
                speed_m_s=np.array([speed]),
                start_s=np.array([start]),
                aside_m=np.array([(lane - place[axis]) * left[axis]]),
                askew_rad=np.array([car.yaw_rad - heading]),
            )
            if _is_free(alone, traffic, times, ego):
                traffic.add(
                    alone.movers,
                    base=alone.base,
                    unit=alone.unit,
                    speed_m_s=alone.speed_m_s,
                    start_s=alone.start_s,
                    aside_m=alone.aside_m,
                    askew_rad=alone.askew_rad,
                )
                gone.add(name)
                break
    return gone


def _is_free(alone: Traffic, traffic: Traffic, times: Float64, ego: Float64) -> bool:
    """Whether a car that leaves keeps clear of the drive, and of all others until it is long gone."""
    start = float(alone.start_s[0])
    after = times >= start - _STEP_S
    mine = alone.poses(times[after])
    if _touch(mine, alone.sizes_m, ego[after][:, None], traffic.style.body_m).any():
        return False
    soon = times[after] < start + 30.0
    others = traffic.poses(times[after][soon])
    size = (alone.movers[0].length_m, alone.movers[0].width_m)
    return not _touch(others, traffic.sizes_m, mine[soon], size).any()
