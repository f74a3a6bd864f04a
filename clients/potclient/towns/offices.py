"""Indoors: rooms with doors and furniture along corridors."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from potclient.towns.site import EAST, NORTH, SOUTH, WEST, Door, Frame, Site
from potclient.towns.solids import Kind, Part, blob, box, placed, post
from potclient.towns.things import (
    chair,
    cupboard,
    desk,
)

_WALL_M = 0.14
_DOOR_M = 0.95
Area = tuple[float, float, float, float]  # lower x, y, upper x, y in a frame, m
Openings = dict[int, list[tuple[float, float]]]  # doorways along each side, m


def build(site: Site) -> None:
    """Fill the block."""
    rng = site.rng
    kind = rng.random()
    if kind < 0.10:
        _lounge(site)
        return
    pair = (SOUTH, NORTH) if rng.random() < 0.6 else (WEST, EAST)
    whole = float((site.upper - site.lower)[1 if pair[0] == SOUTH else 0])
    walled = [k for k in range(4) if k not in pair]
    openings: Openings = {k: [] for k in range(4)}
    if kind < 0.22:
        _row_of_rooms(site, pair[0], whole, openings, hall=True)
        walled.append(pair[1])
    else:
        share = rng.uniform(0.42, 0.58)
        _row_of_rooms(site, pair[0], whole * share, openings, hall=False)
        _row_of_rooms(site, pair[1], whole * (1 - share), openings, hall=False)
    for k in walled:
        _side_wall(site, site.sides[k], openings[k])


def _side_wall(site: Site, side: Frame, openings: list[tuple[float, float]]) -> None:
    """The wall to the corridor, with doorways up to 2.05 m."""
    assert site.style.ceiling_m is not None
    high, parts = site.style.ceiling_m, []
    x = 0.0
    for x0, x1 in [*sorted(openings), (side.length_m, side.length_m)]:
        if x0 > x:
            parts.append(box((x, 0.0, 0.0), (x0, _WALL_M, high), Kind.WALL))
        if x1 > x0:
            parts.append(box((x0, 0.0, 2.05), (x1, _WALL_M, high), Kind.WALL))
        x = x1
    site.parts += side.put(parts)


def _row_of_rooms(site: Site, k: int, depth: float, openings: Openings, *, hall: bool) -> None:
    """Rooms side by side along a corridor; the outer ones may have a second door, noted in `openings` of that side."""
    rng, side = site.rng, site.sides[k]
    assert site.style.ceiling_m is not None
    high = site.style.ceiling_m
    n = 1 if hall else max(1, int((side.length_m - _WALL_M) / rng.uniform(3.4, 5.6)))
    inner = side.length_m - 2 * _WALL_M
    edges = _WALL_M + inner * (np.arange(n + 1) + np.pad(rng.uniform(-0.12, 0.12, n - 1), 1)) / n
    for m in range(n):
        x0, x1 = float(edges[m]), float(edges[m + 1])
        if m:
            x0 += _WALL_M / 2
            site.parts += side.put(
                [box((edges[m] - _WALL_M / 2, 0.0, 0.0), (edges[m] + _WALL_M / 2, depth, high), Kind.WALL)]
            )
        if m < n - 1:
            x1 -= _WALL_M / 2
        free_left = bool(rng.random() < 0.5)  # the side of the door with more room
        door = x1 - 0.85 if free_left else x0 + 0.85
        openings[k].append((door - _DOOR_M / 2, door + _DOOR_M / 2))
        second = [
            x for x, outer in ((0.0, m == 0), (side.length_m, m == n - 1)) if outer and rng.random() < 0.5
        ]
        ways = [_second_door(site, side, x, depth, openings) for x in second]
        closed = bool(rng.random() < 0.22)
        y1 = depth - (_WALL_M if hall else _WALL_M / 2)
        _furnish(site, k, _Room(x0, x1, y1, door, free_left, closed, hall), ways)
    if not hall:
        site.parts += side.put(
            [box((0.0, depth - _WALL_M / 2, 0.0), (side.length_m, depth + _WALL_M / 2, high), Kind.WALL)]
        )
    _side_wall(site, side, openings[k])


def _second_door(site: Site, side: Frame, x: float, depth: float, openings: Openings) -> Area:
    """A doorway at one end of a row; the result is the floor inside it that stays free."""
    y = site.rng.uniform(1.0, depth - 1.2)
    at = side.point(x, y)
    for k, other in enumerate(site.sides):
        if other is not side and abs(float((at - other.origin) @ other.inward)) < 1e-6:
            along = float((at - other.origin) @ other.along)
            openings[k].append((along - _DOOR_M / 2, along + _DOOR_M / 2))
    return (x - 1.4, y - 0.6, x + 1.4, y + 0.6)


class _Room(NamedTuple):
    """The floor inside the walls, m, in the frame of its side, and its door to the corridor."""

    x0: float
    x1: float
    y1: float  # it begins at _WALL_M
    door: float  # middle
    free_left: bool  # on which side of the door there is more room
    closed: bool
    hall: bool


def _furnish(site: Site, k: int, room: _Room, ways: list[Area]) -> None:
    """A door and furniture; `ways` stay free."""
    rng, side = site.rng, site.sides[k]
    _hang_door(site, k, room)
    before, behind = (1.75, 0.75) if room.free_left else (0.75, 1.75)
    taken = [(room.door - before, _WALL_M, room.door + behind, min(room.y1, _WALL_M + 3.3)), *ways]
    wanted = int(rng.integers(8, 14)) if room.hall else int(rng.integers(3, 7))
    if room.hall:
        taken += _table(site, side, room)
    for _ in range(wanted):
        is_desk = rng.random() < 0.55
        parts = desk(rng) if is_desk else cupboard(rng)
        for _attempt in range(6):
            place = _against_a_wall(rng, room, parts)
            if place is None:
                continue
            (x, y, turn), area = place
            fits = area[0] > room.x0 and area[2] < room.x1 and area[1] > _WALL_M and area[3] < room.y1
            if fits and not any(_overlap(area, other) for other in taken):
                taken.append(area)
                site.parts += side.put(parts, x, y, turn)
                break


def _hang_door(site: Site, k: int, room: _Room) -> None:
    side, door, free_left = site.sides[k], room.door, room.free_left
    leaf = [box((0.0, -0.02, 0.0), (_DOOR_M, 0.02, 2.03), Kind.WALL)]
    if room.closed:
        site.parts += side.put(leaf, door - _DOOR_M / 2, _WALL_M / 2)
        return
    # open into the room, towards the near wall
    swing = site.rng.uniform(1.5, 1.62)
    hinge = door + _DOOR_M / 2 if free_left else door - _DOOR_M / 2
    site.parts += side.put(leaf, hinge, _WALL_M + 0.03, swing if free_left else swing + 0.04)
    turn = -1.0 if free_left else 1.0
    if (room.x1 - room.x0) > 3.0 and room.y1 > 4.0:
        site.doors.append(Door(k, side.point(door, _WALL_M / 2), side.inward, turn * side.along))


def _table(site: Site, side: Frame, room: _Room) -> list[Area]:
    """The table of a hall with its chairs, and the floor that it takes; none where the hall is small."""
    rng = site.rng
    wide, long = 1.2, min(5.0, (room.x1 - room.x0) - 6.0)
    if long <= 1.5:
        return []
    cx, cy = (room.x0 + room.x1) / 2, max(_WALL_M + 5.2, 0.6 * room.y1)
    parts = [
        box((-long / 2, -wide / 2, 0.7), (long / 2, wide / 2, 0.75), Kind.FURNITURE),
        post(-long / 4, 0.0, 0.0, 0.7, 0.2, Kind.FURNITURE),
        post(long / 4, 0.0, 0.0, 0.7, 0.2, Kind.FURNITURE),
    ]
    for s in np.arange(-long / 2 + 0.4, long / 2 - 0.2, 0.75):
        parts += chair(rng, s, wide / 2 + 0.25) + placed(chair(rng, s, wide / 2 + 0.25), 0, 0, math.pi)
    site.parts += side.put(parts, cx, cy)
    return [(cx - long / 2 - 0.6, cy - 1.6, cx + long / 2 + 0.6, cy + 1.6)]


def _against_a_wall(
    rng: np.random.Generator, room: _Room, parts: list[Part]
) -> tuple[tuple[float, float, float], Area] | None:
    """A place (x, y, yaw) at the back, left or right wall and the floor it takes; None where the wall is too short."""
    x0, x1, y0, y1 = room.x0, room.x1, _WALL_M, room.y1
    wall = int(rng.integers(3))  # back, left, right
    lower = np.min([v.min(axis=0) for _, v, _ in parts], axis=0)
    upper = np.max([v.max(axis=0) for _, v, _ in parts], axis=0)
    half = float(upper[0])
    if (x1 - x0 if wall == 0 else y1 - y0) < 2 * half + 0.1:
        return None
    if wall == 0:
        x, y = rng.uniform(x0 + half, x1 - half), y1 - 0.02
    else:
        x, y = (x0 + 0.02 if wall == 1 else x1 - 0.02), rng.uniform(y0 + half, y1 - half)
    turn = (math.pi, -math.pi / 2, math.pi / 2)[wall]
    c, s = round(math.cos(turn)), round(math.sin(turn))
    xs = sorted((x + c * lower[0] - s * lower[1], x + c * upper[0] - s * upper[1]))
    ys = sorted((y + s * lower[0] + c * lower[1], y + s * upper[0] + c * upper[1]))
    return (x, y, turn), (xs[0], ys[0], xs[1], ys[1])


def _overlap(a: Area, b: Area) -> bool:
    return a[0] <= b[2] and a[2] >= b[0] and a[1] <= b[3] and a[3] >= b[1]


def _lounge(site: Site) -> None:
    """Open to all corridors: columns, sofas, plants."""
    rng = site.rng
    assert site.style.ceiling_m is not None
    size = site.upper - site.lower
    for fx in (0.0, 0.33, 0.67, 1.0):
        for fy in (0.0, 0.5, 1.0):
            x, y = site.lower + 0.25 + (size - 0.5) * (fx, fy)
            site.parts.append(
                box((x - 0.2, y - 0.2, 0.0), (x + 0.2, y + 0.2, site.style.ceiling_m), Kind.WALL)
            )
    for _ in range(int(rng.integers(5, 10))):
        x, y = rng.uniform(site.lower + 1.5, site.upper - 1.5)
        if rng.random() < 0.6:
            wide = rng.uniform(0.8, 2.0) / 2
            sofa = [
                box((-wide, -0.4, 0.0), (wide, 0.4, 0.45), Kind.FURNITURE),
                box((-wide, 0.2, 0.45), (wide, 0.4, 0.9), Kind.FURNITURE),
            ]
            site.parts += placed(sofa, x, y, float(rng.choice(4)) * math.pi / 2)
        else:
            site.parts.append(post(x, y, 0.0, 0.45, 0.2, Kind.FURNITURE, top_radius_m=0.25))
            site.parts.append(blob((x, y, 1.0), (0.4, 0.4, 0.6), rng, Kind.TREE))
