"""What an operator may choose about mapping. What is tuned and not chosen is a named constant beside its step."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Any

from potserver.errors import SettingsError


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MappingSettings:
    """One map's settings. `profile` sets what the others start from."""

    profile: Annotated[
        str,
        "`default`, or `paper`: as the authors' code",
    ] = "default"

    # range limits
    min_range_m: Annotated[float, "shorter beams are left out: they hit the robot itself"] = 0.3
    max_range_m: Annotated[float, "longer beams are free up to here and end without an echo"] = 25.0
    free_gap_m: Annotated[float, "between a hit and the last free sample of its beam"] = 0.3

    # resolution and storage
    resolution_m: Annotated[
        float,
        "spacing of fine kernels; 0: a 20th of the first scan's median range, 0.2 to 0.4 m, and down to 0.1 m"
        " about hits that lie closely",
    ] = 0.0
    tile_size_m: Annotated[float, "edge of a tile, the unit of storage and of change notices"] = 10.0

    # budgets
    beams_per_scan: Annotated[int, "of a denser scan, so many beams are drawn"] = 30_000
    max_kernels_per_tile: Annotated[int, "further kernels of a full tile are left out"] = 16_000

    # forgetting
    gone_odds: Annotated[
        float, "odds against beams missing what is still there, beyond which it has left; 0: nothing leaves"
    ] = 1e9
    half_life_s: Annotated[
        float, "time in which evidence that nobody renews loses half its weight, by stamps; 0: it never does"
    ] = 0.0

    # self-check
    check_share: Annotated[
        float, "share of the beams that are never learned, only asked for running scores"
    ] = 0.02

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, str):
                continue
            self._need(field.name, math.isfinite(value), "a finite number")
            if field.name in _MAY_BE_ZERO:
                self._need(field.name, value >= 0, "at least 0")
            else:
                self._need(field.name, value > 0, "a positive number")
        self._need("max_range_m", self.max_range_m > self.min_range_m, "above mapping.min_range_m")
        self._need("check_share", self.check_share <= 0.5, "at most 0.5")
        self._need("profile", self.profile in _OF_PROFILE, f"one of {', '.join(_OF_PROFILE)}")
        if self.profile == "paper":
            self._need(
                "half_life_s", self.half_life_s == 0, "0: profile `paper` keeps no evidence that could age"
            )

    def _need(self, name: str, ok: bool, what: str) -> None:
        if not ok:
            raise SettingsError(f"mapping.{name} is {getattr(self, name)!r}, need {what}")

    @staticmethod
    def of_profile(profile: str) -> MappingSettings:
        """What the settings of a profile start from.

        Raises:
            SettingsError: no profile of that name.
        """
        if profile not in _OF_PROFILE:
            raise SettingsError(f"mapping.profile is {profile!r}, need one of {', '.join(_OF_PROFILE)}")
        return MappingSettings(profile=profile, **_OF_PROFILE[profile])


_MAY_BE_ZERO = ("min_range_m", "free_gap_m", "resolution_m", "gone_odds", "half_life_s", "check_share")
_OF_PROFILE: dict[str, dict[str, Any]] = {
    "default": {},
    # what the authors' code does, as far as an operator would choose it; mapping/paper.py has the rest
    "paper": {"max_range_m": 20.0, "beams_per_scan": 8_000, "check_share": 0.0},
}
PROFILES = tuple(_OF_PROFILE)
