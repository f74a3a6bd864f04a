"""What the mapping pipeline may be told. Two profiles: `default` is ours, `paper` repeats the authors' choices."""

from __future__ import annotations

import dataclasses
import math
from enum import Enum

from potschemas.answers import OBSERVED_ACTIVATION, PRIOR_VAR
from potserver.errors import SettingsError
from potserver.numerics.displacement import OutOfSample


class RankScore(str, Enum):
    """How atoms are ranked against a sector."""

    W2 = "w2"  # eq. 7: squared 2-Wasserstein distance of hits plus that of free points
    NORMALISED = (
        "normalised"  # the authors' code: each divided by its largest over all candidates, then added
    )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MappingSettings:
    """Settings of the pipeline; lengths in metres, angles in degrees here because people write them."""

    profile: str = "default"

    # beams
    min_range_m: float = 0.3  # shorter beams hit the robot itself
    max_range_m: float = 25.0  # longer beams are free up to here, and end without an echo
    free_per_beam: int = 5
    gap_m: float = 0.3  # between a hit and its last free point
    beams_per_scan: int = 30_000  # of a denser scan, that many are drawn
    match_beams: int = (
        4_000  # of those, as many are cut into sectors: for transport and the instantaneous map
    )

    # sectors
    n_sectors: int = 6
    align_sectors: bool = (
        True  # turn each sector to its bisector, as atoms are; false: to the map's axes (authors)
    )
    keep_in_sector: bool = (
        True  # transported kernels outside their sector are left out; false: outside the circle (authors)
    )

    # ranking (eq. 6-7)
    rank_hits: int = 48
    rank_free: int = 32
    rank_voxel_m: float = 0.4  # points compared are thinned to one a voxel; 0 draws them at random
    rank_reg_m2: float = 5.0
    rank_tolerance: float = 3e-2
    rank_iterations: int = 1000
    rank_score: RankScore = RankScore.W2
    rotations_deg: tuple[float, ...] = (-30.0, -15.0, 0.0, 15.0, 30.0)

    # final coupling (eq. 3-4)
    couple_points: int = 200
    couple_voxel_m: float = 0.25  # as for ranking
    couple_reg: float = 0.002  # of the largest cost
    couple_tolerance: float = 1e-3
    couple_iterations: int = 2000
    label_aware: bool = (
        True  # free-space kernels move with the free points' own coupling; false: with the hits'
    )
    out_of_sample: OutOfSample = OutOfSample.NEAREST

    # refinement (RePOT)
    refine: bool = True
    prior_var: float = PRIOR_VAR  # log-odds^2, of kernels without a transported prior
    borrowed_var_per_m2: float = (
        10.0  # log-odds^2 for each m^2 of squared distance between atom and sector, added to the
    )
    # variance of transported weights: borrowed is not seen, and the less the farther it was carried
    borrow_weights: bool = (
        True  # transported weights are the prior of refinement; false: positions and widths alone, prior 0
    )
    feature_cut: float = 0.02  # activations below this are left out of the solves
    instant_newton_steps: int = 4  # of the instantaneous map's solve
    instant_gradient_steps: int = 8  # conjugate-gradient steps for each of them

    # overall map
    fine_m: float = 0.0  # resolution; 0: a 25th of the first scan's median range, between 0.2 and 0.4
    newton_steps: int = (
        2  # of each scan's solve, from where the map is; up to three times as many where they are cheap
    )
    gradient_steps: int = 4  # conjugate-gradient steps for each of them
    cheap_values: int = 60_000_000  # features that a solve may touch for more Newton steps
    saturation: float = 20.0  # looks at one place that count; further ones repeat them
    memory: float = 200.0  # looks that one place keeps; older ones give way
    fade_rate: float = 0.05  # by which hits weaken with each scan that sees through them; 0: never
    half_life_s: float = (
        0.0  # in which evidence that nobody renews loses half its weight, by the scans' stamps; 0: never
    )
    max_kernels_per_tile: int = 8_000
    carry_into_map: bool = False  # transported kernels join the overall map too, with their weights as prior

    # answers
    observed_activation: float = OBSERVED_ACTIVATION  # with less around it, a point is unobserved
    residual_var: float = 50.0  # log-odds^2, see KernelMap; 0 is the paper's model
    mean_moderation: float = (
        0.05  # share of the latent variance that pulls means towards 0.5, see KernelMap; 1 is the paper's
    )
    check_share: float = 0.02  # of the beams, that are never learned but asked: the map's own running scores
    calibrate: bool = True  # choose mean_moderation by those scores, once there are enough of them
    tile_size_m: float = 10.0  # the map's unit of storage and of change notices

    def __post_init__(self) -> None:
        for name in (
            "min_range_m",
            "gap_m",
            "fine_m",
            "fade_rate",
            "half_life_s",
            "check_share",
            "borrowed_var_per_m2",
            "residual_var",
            "mean_moderation",
            "rank_voxel_m",
            "couple_voxel_m",
        ):
            self._need(name, getattr(self, name) >= 0, "at least 0")
        for name in (
            "max_range_m", "free_per_beam", "beams_per_scan", "n_sectors", "rank_hits", "rank_free", "rank_reg_m2",
            "rank_tolerance", "rank_iterations", "couple_points", "couple_reg", "couple_tolerance", "couple_iterations",
            "prior_var", "feature_cut", "instant_newton_steps", "instant_gradient_steps",
            "observed_activation", "tile_size_m", "match_beams",
            "newton_steps", "gradient_steps", "cheap_values", "saturation", "memory", "max_kernels_per_tile",
        ):  # fmt: skip
            self._need(name, getattr(self, name) > 0, "positive")
        self._need("rotations_deg", len(self.rotations_deg) > 0, "at least one angle")
        self._need("max_range_m", self.max_range_m > self.min_range_m, "above min_range_m")
        self._need("feature_cut", self.feature_cut < 1, "below 1")
        self._need("check_share", self.check_share <= 0.5, "at most 0.5")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            self._need(field.name, not (isinstance(value, float) and not math.isfinite(value)), "finite")

    def _need(self, name: str, ok: bool, what: str) -> None:
        if not ok:
            raise SettingsError(f"mapping.{name} is {getattr(self, name)}, need {what}")

    @staticmethod
    def of_profile(profile: str) -> MappingSettings:
        """The settings of a named profile.

        Raises:
            SettingsError: no profile of that name.
        """
        try:
            return PROFILES[profile]
        except KeyError:
            raise SettingsError(f"no profile {profile!r}; there are {', '.join(PROFILES)}") from None


# The authors' published code, as far as it is a choice and not a bug: five sectors of 72 degrees, 20 m, coordinates in the
# map's axes, random subsamples of 200 hits and 50 free points, hits and free points scored apart and normalised, eight
# 45-degree turns of the atom, all kernels moved by the hits' coupling with the nearest point's displacement, full-circle
# crop, plain concatenation. They work in coordinates divided by 50, so their ranking reg of 0.005 is 0.005 * 50^2 m^2.
# What differs: one fixed subsample an atom instead of a new one a candidate (theirs makes the choice random); marginal errors
# in L1; a failed coupling is solved again with four times the reg, where they add noise; atoms keep at most 500 points a
# label, turned to their bisector; dispersions of position and gamma are carried, where they drop them; points without any
# kernel near are answered as unobserved.
PAPER = MappingSettings(
    profile="paper",
    max_range_m=20.0,
    free_per_beam=2,
    beams_per_scan=8_000,
    match_beams=8_000,
    n_sectors=5,
    align_sectors=False,
    keep_in_sector=False,
    rank_hits=200,
    rank_free=50,
    rank_reg_m2=0.005 * 50.0**2,
    rank_tolerance=1e-6,
    rank_voxel_m=0.0,
    rank_score=RankScore.NORMALISED,
    rotations_deg=tuple(45.0 * k for k in range(-4, 4)),
    couple_points=1500,
    couple_reg=0.0005,
    couple_tolerance=1e-4,
    couple_iterations=2000,
    couple_voxel_m=0.0,
    label_aware=False,
    out_of_sample=OutOfSample.NEAREST,
    refine=False,
    residual_var=0.0,
    mean_moderation=1.0,
    check_share=0.0,
    calibrate=False,
)

PROFILES = {"default": MappingSettings(), "paper": PAPER}
