"""What makes the towns different from each other."""

from __future__ import annotations

import dataclasses

from potclient.errors import DatasetError


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """The measures of a town; blocks are built by `potclient.towns.blocks`.

    `pitch_m` is the mean distance of neighbouring streets that run north and of those that run east; each is off its regular
    place by up to `irregular` of it. `street_width_m` is from kerb to kerb, with a lane for parking of `parking_m` on each
    side; one drives `lane_share` of the rest right of the middle.
    """

    name: str
    summary: str
    pitch_m: tuple[float, float]
    irregular: float
    street_width_m: tuple[float, float]
    parking_m: float
    lane_share: float = 0.25
    kerb_m: float = 0.12  # height of the pavement
    corner_m: float = 2.5  # cut off the corners of the pavement
    speed_m_s: float
    turning: float  # how much turns are liked against going straight on
    turn_left_m: float
    turn_right_m: float
    traffic_gap_m: float  # mean distance of moving cars in a lane
    traffic_m_s: float
    leaving: float  # share of parked cars that may leave in a dynamic town
    ceiling_m: float | None = None  # indoors
    sensor_m: float  # height of a 3D sensor
    slice_m: float  # height of the planar scanner
    body_m: tuple[float, float]  # length and width of what carries the sensor


STYLES = {
    style.name: style
    for style in (
        Style(
            name="terraces",
            summary="narrow streets of row houses close to the kerb, garden walls, cars parked on both sides",
            pitch_m=(60.0, 84.0),
            irregular=0.12,
            street_width_m=(9.2, 10.4),
            parking_m=2.0,
            speed_m_s=8.0,
            turning=1.3,
            turn_left_m=6.0,
            turn_right_m=5.5,
            traffic_gap_m=55.0,
            traffic_m_s=7.0,
            leaving=0.15,
            sensor_m=1.73,
            slice_m=0.7,
            body_m=(4.4, 1.8),
        ),
        Style(
            name="suburb",
            summary="detached houses set back behind lawns, hedges and trees, few cars",
            pitch_m=(92.0, 78.0),
            irregular=0.15,
            street_width_m=(9.2, 10.4),
            parking_m=2.0,
            speed_m_s=10.0,
            turning=1.2,
            turn_left_m=7.0,
            turn_right_m=6.0,
            corner_m=3.5,
            traffic_gap_m=90.0,
            traffic_m_s=9.0,
            leaving=0.5,
            sensor_m=1.73,
            slice_m=0.7,
            body_m=(4.4, 1.8),
        ),
        Style(
            name="downtown",
            summary="large blocks of tall buildings on wide streets, arcades, open squares, rows of trees and poles",
            pitch_m=(104.0, 96.0),
            irregular=0.12,
            street_width_m=(14.0, 20.0),
            parking_m=2.2,
            speed_m_s=12.0,
            turning=1.0,
            turn_left_m=10.0,
            turn_right_m=7.0,
            corner_m=4.0,
            traffic_gap_m=40.0,
            traffic_m_s=11.0,
            leaving=0.2,
            sensor_m=1.73,
            slice_m=0.7,
            body_m=(4.4, 1.8),
        ),
        Style(
            name="offices",
            summary="indoors: corridors, rooms with doors, desks, chairs and cupboards",
            pitch_m=(19.0, 14.5),
            irregular=0.08,
            street_width_m=(1.9, 2.7),
            parking_m=0.0,
            lane_share=0.0,
            kerb_m=0.0,
            corner_m=0.0,
            speed_m_s=0.8,
            turning=1.3,
            turn_left_m=0.7,
            turn_right_m=0.7,
            traffic_gap_m=28.0,
            traffic_m_s=1.2,
            leaving=0.0,
            ceiling_m=2.7,
            sensor_m=0.9,
            slice_m=0.4,
            body_m=(0.6, 0.5),
        ),
    )
}


def style_named(name: str) -> Style:
    """The style of that name.

    Raises:
        DatasetError: there is none.
    """
    if name not in STYLES:
        raise DatasetError(f"town style {name!r}: need one of {', '.join(STYLES)}")
    return STYLES[name]
