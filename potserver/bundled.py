"""The recordings that the package ships (see NOTICE), opened the way the demo and the atom builder use them."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path

from potclient.datasets import Recording, open_dataset
from potclient.datasets.planar import PlanarSlice

STREET = "street"  # two outdoor LiDAR scans, 0.5 m apart
ROOMS = "rooms"  # twelve scans of a simulated indoor scene: four places, three headings
PLAN = "plan"  # the rooms in 2D: beams that clear the floor, seen from above
STREET_PLAN = "street-plan"  # the street in 2D: its nearly horizontal beams
NAMES = (STREET, ROOMS, PLAN, STREET_PLAN)

_ROOMS_MAX_RANGE_M = 8.0  # longer readings of that simulated sensor are beams without an echo


def open_bundled(name: str) -> Recording:
    """One of the bundled recordings by name; KeyError for another name."""
    return {
        STREET: _street,
        ROOMS: _rooms,
        PLAN: lambda: PlanarSlice(_rooms(), (math.radians(2.0), math.radians(15.0))),
        STREET_PLAN: lambda: PlanarSlice(_street(), (math.radians(-1.5), math.radians(1.5))),
    }[name]()


def _street() -> Recording:
    return open_dataset(_folder("outdoor_street"))


def _rooms() -> Recording:
    return open_dataset(_folder("indoor_rooms"), max_range_m=_ROOMS_MAX_RANGE_M)


def _folder(name: str) -> Path:
    return Path(str(resources.files("potserver") / "data" / "scans" / name))
