"""Every message that crosses the wire, typed once.

The Struct is the source of truth: `python -m potschemas.generate` makes from it, and from the comment beside
each field, the JSON Schemas in `json/`, the golden byte vectors in `vectors/` and the tables of the README. A
message is a MessagePack map with these field names; arrays travel as `Array`. Coordinates are metres, angles
radians, stamps nanoseconds since the Unix epoch, and every pose says both of its frames:
`p_map = T_map_sensor @ p_sensor`.

Receivers ignore fields that they do not know, so that a field with a default may be added within a version;
anything else (a new required field, another meaning, a new enum value) needs a new schema version.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from enum import Enum
from typing import Annotated, ClassVar

import msgspec

_INT64_MAX = 2**63 - 1  # every integer fits into a signed 64-bit one, which all languages have
_FLOAT_MAX = sys.float_info.max

Count = Annotated[int, msgspec.Meta(ge=0, le=_INT64_MAX)]
PositiveCount = Annotated[int, msgspec.Meta(ge=1, le=_INT64_MAX)]
Sequence = Annotated[int, msgspec.Meta(ge=0, le=_INT64_MAX)]
ReceiptSequence = Annotated[int, msgspec.Meta(ge=-1, le=_INT64_MAX)]
Finite = Annotated[float, msgspec.Meta(ge=-_FLOAT_MAX, le=_FLOAT_MAX)]  # neither NaN nor infinite
Positive = Annotated[float, msgspec.Meta(gt=0, le=_FLOAT_MAX)]
WaitSeconds = Annotated[float, msgspec.Meta(ge=0, le=_FLOAT_MAX)]
# NaN or infinite where nothing was measured, which JSON shows as null: the mark tells the generator
Measured = Annotated[float, msgspec.Meta(extra_json_schema={"nan_is_null": True})]
# `$` alone would let a trailing newline pass
Identifier = Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9][a-z0-9_.-]{0,62}$(?!\n)")]
Dims = Annotated[int, msgspec.Meta(ge=2, le=3)]
Vector3 = Annotated[list[Finite], msgspec.Meta(min_length=3, max_length=3)]
Slope = Annotated[list[Finite], msgspec.Meta(min_length=2, max_length=2)]
GridShape = Annotated[list[Count], msgspec.Meta(min_length=3, max_length=3)]
_Int64 = Annotated[int, msgspec.Meta(ge=-_INT64_MAX - 1, le=_INT64_MAX)]
Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]
_Quantile = Annotated[float, msgspec.Meta(gt=0, lt=1)]
Quantiles = Annotated[list[_Quantile], msgspec.Meta(max_length=16)]
TileIndex = Annotated[list[_Int64], msgspec.Meta(min_length=3, max_length=3)]
WeightStep = Annotated[float, msgspec.Meta(ge=1e-4, le=10)]
LatticeCells = Annotated[list[PositiveCount], msgspec.Meta(min_length=3, max_length=3)]

# The type and the default of a field that a released schema got later: it is left out of the bytes, so that messages without
# it stay as they were.
Absent = msgspec.UnsetType
ABSENT = msgspec.UNSET

MAX_AXES = 4
MAX_AXIS_LENGTH = 2**31 - 1
MAX_PART_KERNELS = 100_000  # in one part of a `q/tiles` reply: what a receiver has to be ready to unpack
_AxisLength = Annotated[int, msgspec.Meta(ge=0, le=MAX_AXIS_LENGTH)]
ArrayShape = Annotated[list[_AxisLength], msgspec.Meta(max_length=MAX_AXES)]


class DType(str, Enum):
    """Element types that an array may have: little-endian, and nothing that needs pickle."""

    FLOAT32 = "<f4"
    FLOAT64 = "<f8"
    INT64 = "<i8"
    UINT8 = "|u1"
    BOOL = "|b1"


class Array(msgspec.Struct, frozen=True, kw_only=True):
    """A dense, C-ordered, little-endian array."""

    dtype: DType  # element type
    shape: ArrayShape  # at most 4 axes; the empty list is one single number
    data: bytes  # a MessagePack bin object of product(shape) elements; never a string


class Packed(msgspec.Struct, frozen=True, kw_only=True):
    """A dense array, little-endian and deflated byte by byte: the first byte of every element, then the second, and so on.

    Bytes of equal weight are alike, so they deflate better together than element by element.
    """

    dtype: DType  # element type
    shape: ArrayShape  # as in `Array`
    deflated: bytes  # a zlib stream (RFC 1950) that inflates to exactly product(shape) elements, in C order


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """Base of all messages; `schema` is what the Zenoh encoding names after the semicolon."""

    schema: ClassVar[str] = ""


# --- clouds in ------------------------------------------------------------------------------------


class ParamsKind(str, Enum):
    """Which parameters of a cloud come back."""

    FITTED = "fitted"  # kernels solved on the cloud's labels, beyond what the dictionary expects there
    TRANSPORTED = "transported"  # the kernels of the nearest atoms, carried by optimal transport and refined by the labels
    NONE = "none"  # none are computed


class Cloud(Message, frozen=True, kw_only=True):
    """One scan with its pose: the payload of `in/<robot>/cloud` and of `in/<robot>/integrate`."""

    schema: ClassVar[str] = "pot.cloud.v1"

    seq: Sequence  # the robot's own counter, echoed in the receipt
    stamp_ns: Sequence  # when the scan was taken
    points: Array  # (N, 3) or (N, 2) float32, m, sensor frame; 2D is 3D with z = 0
    T_map_sensor: Array | None = None  # (4, 4) float64, rigid; absent = by the pose stream at stamp_ns
    is_return: Array | None = None  # (N,) bool; false = no echo, free up to the point; absent = all true
    robot: Identifier | None = None  # who sends, in kept clouds; on the wire the key says it
    session: Identifier | Absent = ABSENT  # one run of the sender; `seq` grows within it
    params: ParamsKind | Absent = ABSENT  # what comes back; absent = fitted, where somebody reads it


class Pose(Message, frozen=True, kw_only=True):
    """One pose of a robot's optional pose stream, `in/<robot>/pose`."""

    schema: ClassVar[str] = "pot.pose.v1"

    stamp_ns: Sequence  # when the robot was there
    T_map_sensor: Array  # (4, 4) float64, rigid


# --- kernels --------------------------------------------------------------------------------------


class Lean(msgspec.Struct, frozen=True, kw_only=True):
    """What a map expects in some of its tiles, in log-odds, to which the sums over its kernels are added: `potschemas.lean`."""

    tile_size_m: Positive  # m, edge of a tile; its lower corner is index * tile_size_m
    tiles: Packed  # (4, L) int64: index x, y, z and revision of each tile
    nodes: Packed  # (L, X, Y, Z) uint8: (byte - 128) / 16 log-odds, on nodes from corner to corner; trilinear between them


class Kernels(Message, frozen=True, kw_only=True):
    """K kernels in the map frame, ten numbers each, and the rule that turns them into answers: its last four fields.

    The latent is f(x) = sum_m w_m exp(-gamma_m |x - h_m|^2), gamma_m = gamma_shape_m / gamma_rate_m. `potschemas.answers`
    and "From kernels to answers" in the README have what follows from it.
    """

    schema: ClassVar[str] = "pot.kernels.v1"

    origin: Vector3  # m, map frame; added to hinge_mean
    hinge_mean: Array  # (K, 3) float32, m, relative to origin
    hinge_var: Array  # (K, 3) float32, m^2, along the map axes
    gamma_shape: Array  # (K,) float32, > 0
    gamma_rate: Array  # (K,) float32, m^2, > 0; the mean of gamma is shape / rate, in 1/m^2
    weight_mean: Array  # (K,) float32, log-odds
    weight_var: Array  # (K,) float32, log-odds^2
    observed_activation: Finite  # summed activation of known weights, below which a point is unobserved
    prior_var: Finite  # log-odds^2, of the latent where nothing was observed
    residual_var: Finite  # log-odds^2, added in the measure that this sum falls short of 1
    mean_moderation: Finite = 1.0  # share of the latent variance that pulls the mean towards 0.5
    full_activation: Finite = 0.0  # what a full lattice of known weights sums to; 0: on none
    lean: Lean | Absent = ABSENT  # of a map that leans: its latent is this and the sum over the kernels
    nodes: TileChanges | Absent = ABSENT  # more kernels: nodes of one tile at origin, based on nothing


class Borrowed(msgspec.Struct, frozen=True, kw_only=True):
    """A part of the dictionary that the kernels of a scan lean on, and where it was put."""

    name: str  # of what the dictionary has learned: `expectation`
    weight: Probability  # share of what is expected
    displacement: Vector3  # m, map frame: where its origin was put, which is the ground below the sensor
    slope: Slope  # of that ground along x and y
    scale: Probability  # of its log-odds: how well the labels bear them out


class SectorReport(msgspec.Struct, frozen=True, kw_only=True):
    """How one sector of a scan found its atom and how the transport ended."""

    azimuth_min_rad: Finite  # rad, sensor frame
    azimuth_max_rad: Finite  # rad, sensor frame
    n_hits: Count  # echoes in the sector
    n_free: Count  # free-space samples in the sector
    atom_id: str | None  # none: the sector was left without an atom, `reason` says why
    rotation_rad: Measured  # rad, by which the atom was turned; no meaning without one
    w2_m2: Measured  # m^2, squared 2-Wasserstein distance (entropic plan) to the atom; not finite without one
    n_kernels: Count  # kernels this sector gave to the instantaneous map
    converged: bool  # the solver reached its tolerance
    marginal_error: Measured  # L1 distance of the plan's marginals from uniform; not finite without one
    n_iterations: Count  # of the solver
    reason: str | None = None  # for people: why there is no atom


class ReceiptStatus(str, Enum):
    """What became of a cloud."""

    ACCEPTED = "accepted"  # it is in the map
    DROPPED = "dropped"  # sound, but not taken: load or shutdown
    REJECTED = "rejected"  # unsound: it will never be taken as it is


class Receipt(Message, frozen=True, kw_only=True):
    """The answer to every cloud: `out/<robot>/receipt`, and the reply to `in/<robot>/integrate`."""

    schema: ClassVar[str] = "pot.receipt.v1"

    map: Identifier  # the map that was asked
    robot: str  # who sent the cloud; not a legal id if that is why it was rejected
    seq: ReceiptSequence  # of the cloud; -1 if it could not be read
    status: ReceiptStatus  # accepted, dropped or rejected
    reason: str | None = None  # an ErrorCode value, when not accepted
    message: str | None = None  # for people
    queue_depth: Count = 0  # clouds waiting when the receipt was written
    wait_ms: Finite = 0.0  # ms, time in the queue
    integrate_ms: Finite = 0.0  # ms, time in the mapper
    map_revision: Count = 0  # after this cloud
    n_points: Count = 0  # beams used
    n_kernels: Count = 0  # kernels of the instantaneous map
    n_kernels_added: Count = 0  # kernels that the overall map took
    n_kernels_transported: Count = 0  # of those, carried from atoms; the others were placed on the data
    map_kernels: Count = 0  # kernels in the overall map now
    sectors: list[SectorReport] = []  # how each sector was served; of transported parameters
    kernels: Kernels | None = None  # the instantaneous map; in replies to `in/<robot>/integrate` only
    next_seq: Count | Absent = ABSENT  # `old_seq` only: the least `seq` of the session that would be taken
    borrowed: list[Borrowed] | Absent = ABSENT  # what fitted kernels lean on


class Params(Message, frozen=True, kw_only=True):
    """The parameters of one cloud: `out/<robot>/params`."""

    schema: ClassVar[str] = "pot.params.v1"

    map: Identifier  # the map that took the cloud
    robot: Identifier  # who sent the cloud
    seq: Sequence  # of the cloud
    stamp_ns: Sequence  # of the cloud
    map_revision: Count  # of the overall map, after this cloud
    kernels: Kernels  # the instantaneous map: this cloud alone
    sectors: list[SectorReport] = []  # how each sector was served; of transported parameters
    borrowed: list[Borrowed] | Absent = ABSENT  # what fitted kernels lean on


class Revision(Message, frozen=True, kw_only=True):
    """The map changed: `ev/revision`."""

    schema: ClassVar[str] = "pot.revision.v1"

    map: Identifier  # which map
    map_revision: Count  # the new one; grows by one a change
    stamp_ns: Sequence  # when the change was made
    n_kernels: Count  # in the overall map now
    tile_size_m: Positive  # m, edge of a tile
    changed_tiles: list[TileIndex]  # floor(p_map / tile_size_m)


# --- queries --------------------------------------------------------------------------------------


class PointsQuery(Message, frozen=True, kw_only=True):
    """`q/points`: occupancy at any points."""

    schema: ClassVar[str] = "pot.points_query.v1"

    points: Array  # (N, 3) or (N, 2) float32 or float64, m, map frame
    deadline_ms: Positive | None = None  # ms from arrival; past it no work and no part begins
    with_gradient: bool | Absent = ABSENT  # true: the answer brings both gradients
    evidence_only: bool | Absent = ABSENT  # true: nothing is borrowed, what is not observed is unknown


class Occupancy(Message, frozen=True, kw_only=True):
    """What the map says at N points, in the order asked."""

    schema: ClassVar[str] = "pot.occupancy.v1"

    mean: Array  # (N,) float32, P(occupied)
    var: Array  # (N,) float32, variance of that probability: its squared error as expected, in [0, 0.25]
    latent_mean: Array  # (N,) float32, log-odds
    latent_var: Array  # (N,) float32, log-odds^2
    observed: Array  # (N,) bool; false = nothing was seen near: `mean` is 0.5, or what is expected there
    map_revision: Count  # all answers are of this one
    borrowed: Array | Absent = ABSENT  # (N,) float32, share that is expected, not seen; absent = 0
    gradient: Array | Absent = ABSENT  # (N, 3) float32, 1/m, of `mean`; 0 where nothing is known
    latent_gradient: Array | Absent = ABSENT  # (N, 3) float32, log-odds/m, of `latent_mean`; likewise


class GridQuery(Message, frozen=True, kw_only=True):
    """`q/grid`: occupancy at the cell centres of a box; the reply comes in parts."""

    schema: ClassVar[str] = "pot.grid_query.v1"

    lower: Vector3  # m, map frame; the box's corner, cell (0, 0, 0) starts here
    upper: Vector3  # m, map frame; above `lower` on every axis
    resolution: Positive  # m, cell edge
    deadline_ms: Positive | None = None  # ms from arrival; past it no work and no part begins
    evidence_only: bool | Absent = ABSENT  # true: nothing is borrowed, what is not observed is unknown


class GridPart(Message, frozen=True, kw_only=True):
    """One run of cells of a grid, in C order of (x, y, z) indices; all parts come from one map revision."""

    schema: ClassVar[str] = "pot.grid_part.v1"

    part: Count  # 0 .. n_parts - 1; parts may arrive in any order
    n_parts: PositiveCount  # how many parts the whole reply has
    shape: GridShape  # cells along x, y, z of the whole grid
    first_cell: Count  # flat index of this part's first cell
    lower: Vector3  # m, map frame; cell (i, j, k) is centred at lower + (i + .5, j + .5, k + .5) * resolution
    resolution: Positive  # m, cell edge
    occupancy: Occupancy  # of the cells first_cell, first_cell + 1, ...


class Unknown(str, Enum):
    """What rays and robots take unobserved space for."""

    OCCUPIED = "occupied"  # it stops a ray; touching it is a collision
    FREE = "free"  # as if nothing were there
    PRIOR = "prior"  # as the map answers for it: what is expected there, or occupied with probability 0.5


class RaysQuery(Message, frozen=True, kw_only=True):
    """`q/rays`: where rays first return. The hazard along a ray is -ln(1 - p) / width, with p the mean of the occupancy."""

    schema: ClassVar[str] = "pot.rays_query.v1"

    origins: Array  # (N, 3) or (N, 2) float32 or float64, m, map frame
    directions: Array  # (N, 3) or (N, 2) float32 or float64, map frame, of any length but 0
    max_range_m: Positive  # m, of all rays
    quantiles: Quantiles | None = None  # ascending, of the range to answer; absent = [0.05, 0.5, 0.95]
    unknown: Unknown = Unknown.PRIOR  # what rays take unobserved space for
    width_m: Positive | None = None  # m, over which p counts as one trial; absent = the kernels' own
    step_m: Positive | None = None  # m, longest step of the summation; absent = fine enough
    deadline_ms: Positive | None = None  # ms from arrival; past it no work and no part begins
    evidence_only: bool | Absent = ABSENT  # true: nothing is borrowed, what is not observed is unknown


class Rays(Message, frozen=True, kw_only=True):
    """The distribution of min(first return, max_range_m) of N rays, in the order asked; ranges from the origins."""

    schema: ClassVar[str] = "pot.rays.v1"

    hit_probability: Array  # (N,) float32, of a return before max_range_m
    mean_m: Array  # (N,) float32, m, expected range
    std_m: Array  # (N,) float32, m, its standard deviation
    quantile_m: Array  # (N, Q) float32, m; max_range_m where a return before it is too unlikely
    unknown_range_m: Array  # (N,) float32, m, where the ray enters unobserved space; NaN = it does not
    unknown_share: Array  # (N,) float32, of the ray's expected length, in unobserved space
    step_m: Positive  # m, the longest step that was taken
    map_revision: Count  # all answers are of this one
    borrowed_share: Array | Absent = ABSENT  # (N,) float32, of it: what is expected, not seen; absent = 0


class RiskQuery(Message, frozen=True, kw_only=True):
    """`q/risk`: how likely a robot on a path touches something. Nothing is covered between the poses."""

    schema: ClassVar[str] = "pot.risk_query.v1"

    path: Array  # (P, 4, 4) float64, T_map_body, rigid
    spheres: Array  # (S, 4) float32 or float64, m: centre in the body frame, and radius
    unknown: Unknown = Unknown.OCCUPIED  # what unobserved cells are taken for
    resolution_m: Positive | None = None  # m, edge of a cell; absent = half the smallest radius
    correlation_m: Positive | None = None  # m, edge of a cube that is one trial; absent = the kernels' own
    dims: Dims = 3  # 2 = the spheres are discs in the plane z = 0
    deadline_ms: Positive | None = None  # ms from arrival; past it no work and no part begins
    evidence_only: bool | Absent = ABSENT  # true: nothing is borrowed, what is not observed is unknown


class Risk(Message, frozen=True, kw_only=True):
    """The risk of a path. A cell is covered when its centre lies in a sphere, or a sphere's centre lies in it.

    Cell (i, j, k) is centred at (i + .5, j + .5, k + .5) * resolution_m in the map frame. With d = `dims`, the union is
    1 - exp(-sum -ln(1 - p) (resolution_m / correlation_m)^d) over the cells, but at least the likeliest cell.
    """

    schema: ClassVar[str] = "pot.risk.v1"

    max_probability: Array  # (P,) float32, of the likeliest cell: all cells are one trial
    union_probability: Array  # (P,) float32, that any cell is occupied, by cubes of correlation_m
    unknown_share: Array  # (P,) float32, of its cells, unobserved
    path_max_probability: Probability  # of the likeliest cell of the swept volume
    path_union_probability: Probability  # that any cell of the swept volume is occupied, each counted once
    path_unknown_share: Probability  # of the swept volume's cells, unobserved
    n_cells: Count  # of the swept volume
    resolution_m: Positive  # m, edge of a cell
    map_revision: Count  # all answers are of this one
    borrowed_share: Array | Absent = ABSENT  # (P,) float32, of them: what is expected, not seen; absent = 0
    path_borrowed_share: Probability | Absent = ABSENT  # of the swept volume's; absent = 0


class ParamsQuery(Message, frozen=True, kw_only=True):
    """`q/params`: the kernels of the overall map, whole or inside a box; the reply comes in parts."""

    schema: ClassVar[str] = "pot.params_query.v1"

    lower: Vector3 | None = None  # m, map frame, on hinge means
    upper: Vector3 | None = None  # m, map frame; give both corners or neither
    deadline_ms: Positive | None = None  # ms from arrival; past it no work and no part begins


class ParamsPart(Message, frozen=True, kw_only=True):
    """One part of a `q/params` reply."""

    schema: ClassVar[str] = "pot.params_part.v1"

    part: Count  # 0 .. n_parts - 1; parts may arrive in any order
    n_parts: PositiveCount  # how many parts the whole reply has
    map_revision: Count  # the same in all parts
    kernels: Kernels  # this part's kernels; the origin may differ from part to part


class TilesQuery(Message, frozen=True, kw_only=True):
    """`q/tiles`: what of the map's tiles differs from what the asker has; the reply comes in parts."""

    schema: ClassVar[str] = "pot.tiles_query.v1"

    lower: Vector3 | None = None  # m, map frame; of a box: the tiles that it touches are meant
    upper: Vector3 | None = None  # m, map frame; an absent corner is no bound on its side
    epoch: Count | None = None  # that `known` is of, from an earlier reply; absent = nothing is known
    known: Packed | None = None  # (4, N) int64: index x, y, z and revision of each tile that the asker has
    deadline_ms: Positive | None = None  # ms from arrival; past it no work and no part begins
    step: WeightStep | Absent = ABSENT  # log-odds, of weights: tiles come as `changes`; absent = exact


class CodedKernels(msgspec.Struct, frozen=True, kw_only=True):
    """K kernels of some tiles, hinges relative to the lower corners of their tiles. A kind is a shape and a lattice.

    The hinge of a kernel whose kind has a spacing is offset + cell * spacing, computed in float64 and rounded to float32.
    """

    kinds: Packed  # (5, U) float32: hinge_var along x, y, z, m^2; gamma_shape; gamma_rate, m^2
    lattices: Packed  # (4, U) float64, m: spacing of each kind, 0 = none; offset along x, y, z
    kind: Packed | None = None  # (K,) uint8 or int64, which kind each is of; absent = each its own, U is K
    cells: Packed  # (3, L) uint8 or int64: of the L kernels whose kinds have a spacing, in order
    hinge_mean: Packed  # (3, K - L) float32, m: of the others, in order
    weight_mean: Packed  # (K,) float32, log-odds
    weight_var: Packed  # (K,) float32, log-odds^2


class LatticeNodes(msgspec.Struct, frozen=True, kw_only=True):
    """Nodes of one lattice in T of a part's tiles, relative to what the asker has of it there.

    Node (x, y, z) of the t-th of them has the number t * X Y Z + (x * Y + y) * Z + z, with X, Y, Z of `cells`. Its hinge from
    the tile's corner is offset + (x, y, z) * spacing, computed in float64 and rounded to float32. Signed numbers n travel as
    2 n where n >= 0, and else as -2 n - 1.
    """

    shape: Packed  # (5,) float32 that all nodes share: hinge_var along x, y, z, m^2; gamma_shape; gamma_rate, m^2
    spacing: Positive  # m
    offset: Vector3  # m
    cells: LatticeCells  # nodes along x, y, z
    tiles: Packed  # (T,) int64, columns of the part's `tiles`, ascending
    toggled: Packed  # (M,) int64: numbers of nodes that come or go, ascending, as differences from -1 on
    mean_changes: Packed  # (S,) int64, signed: change in steps of the means of nodes that stay, by number
    var_changes: Packed  # (S,) int64, signed: likewise of the variances
    new_means: Packed  # (N,) int64, signed: means in steps of the nodes that come, by number
    new_vars: Packed  # (N,) int64, signed: variances, in steps from `var_unit`


class TileChanges(msgspec.Struct, frozen=True, kw_only=True):
    """Nodes of the part's tiles in whole steps: mean = n * step, var = var_unit * exp(n * var_step)."""

    step: Positive  # log-odds
    var_step: Positive  # of the logarithm
    var_unit: Positive  # log-odds^2
    based: Packed  # (T,) bool, of each tile: relative to what the asker has; false = to nothing
    lattices: list[LatticeNodes]  # of a tile in none of them no nodes are left


class TilesPart(Message, frozen=True, kw_only=True):
    """One part of a `q/tiles` reply: a run of kernels, tile after tile. Without `changes` a tile may go on in the next part."""

    schema: ClassVar[str] = "pot.tiles_part.v1"

    part: Count  # 0 .. n_parts - 1; parts may arrive in any order
    n_parts: PositiveCount  # how many parts the whole reply has
    epoch: Count  # drawn anew when a map is created, cleared or loaded; only revisions of one can be compared
    map_revision: Count  # the same in all parts
    whole: bool  # the epoch is not the asker's: these are all tiles of the box, what it had is void
    tile_size_m: Positive  # m, edge of a tile; its lower corner is index * tile_size_m
    tiles: Packed  # (4, T) int64: index x, y, z and revision of each tile with kernels that differs
    counts: Packed  # (T,) int64, how many of `kernels` are of each tile; at least 1 without `changes`
    gone: Packed | None = None  # (3, G) int64, indices of tiles known to the asker and not there; in part 0
    kernels: CodedKernels  # of the tiles one after the other, but for those in `changes`
    observed_activation: Finite  # summed activation of known weights, below which a point is unobserved
    prior_var: Finite  # log-odds^2, of the latent where nothing was observed
    residual_var: Finite  # log-odds^2, added in the measure that this sum falls short of 1
    mean_moderation: Finite  # share of the latent variance that pulls the mean towards 0.5
    full_activation: Finite = 0.0  # what a full lattice of known weights sums to; 0: on none
    changes: TileChanges | Absent = ABSENT  # where the query has a step
    lean: Lean | Absent = ABSENT  # of tiles that differ; with `changes` of those where it is new


class AtomInfo(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the dictionary's table."""

    atom_id: str  # its name in the dictionary
    dims: Dims  # 2 or 3
    n_hits: Count  # echoes it was learned from
    n_free: Count  # free-space samples it was learned from
    n_kernels: Count  # kernels it carries
    radius_m: Positive  # m, of the sector
    azimuth_width_rad: Positive  # rad, opening of the sector
    times_used: Count  # sectors this atom has served since the server started
    provenance: dict[str, str]  # source, scan, sector, licence, learner, held-out scores


class PlaceInfo(msgspec.Struct, frozen=True, kw_only=True):
    """What a place has taught the dictionary, see `ctl/learn`."""

    name: str  # as it was learned
    times_used: Count  # scans that leaned on it since the server started
    provenance: dict[str, str]  # how many scans, the newest stamp, held-out NLL before and with it


class AtomList(Message, frozen=True, kw_only=True):
    """The reply to an `AtomsQuery` that reads, without an id."""

    schema: ClassVar[str] = "pot.atom_list.v1"

    atoms: list[AtomInfo]  # in dictionary order
    places: list[PlaceInfo] | Absent = ABSENT  # that the dictionary has grown by; absent = none


class Atom(Message, frozen=True, kw_only=True):
    """One atom whole: the reply to an `AtomsQuery` that reads one, and what a `*.atom` file holds."""

    schema: ClassVar[str] = "pot.atom.v1"

    info: AtomInfo  # its line in the table
    hit_points: Array  # (H, 3) float32, m, atom frame: sensor at the origin, x along the sector's bisector
    free_points: Array  # (F, 3) float32, m, atom frame
    kernels: Kernels  # atom frame


class AtomsAction(str, Enum):
    """What `q/atoms` (read) and `ctl/atoms` (add, remove) are asked to do."""

    READ = "read"  # list the dictionary, or fetch one atom
    ADD = "add"  # put an atom into the dictionary, for every map of the server
    REMOVE = "remove"  # take one out; maps keep the kernels that were carried from it


class AtomsQuery(Message, frozen=True, kw_only=True):
    """`q/atoms`: list the dictionary, or fetch one atom whole. `ctl/atoms`: change the dictionary."""

    schema: ClassVar[str] = "pot.atoms_query.v1"

    atom_id: str | None = None  # which one to fetch or to remove; absent = list all, or add `atom`
    action: AtomsAction | Absent = ABSENT  # absent = read
    atom: Atom | Absent = ABSENT  # to be added; its times_used and its kernels' scalars do not matter


class AtomsChanged(Message, frozen=True, kw_only=True):
    """The reply to an `AtomsQuery` that added or removed an atom; scans that are integrated from now on see the change."""

    schema: ClassVar[str] = "pot.atoms_changed.v1"

    atom_id: str  # which atom came or went
    n_atoms: Count  # in the dictionary now
    persisted: bool  # true: it is on the server's disk; false: a restart of the server forgets it


class InfoQuery(Message, frozen=True, kw_only=True):
    """`q/info`; an empty payload is taken as this message."""

    schema: ClassVar[str] = "pot.info_query.v1"


class Limits(msgspec.Struct, frozen=True, kw_only=True):
    """What the server accepts; a client may check before it sends."""

    max_cloud_bytes: Count  # of one cloud's payload
    max_cloud_points: Count  # beams in one cloud
    max_query_bytes: Count  # of one query's payload
    max_query_points: Count  # in one `q/points`
    max_grid_cells: Count  # in one `q/grid`
    max_range_m: Finite  # m, beams are used up to here
    max_coordinate_m: Finite  # m, |x|, |y|, |z| in the map frame
    max_query_rays: Count | Absent = ABSENT  # in one `q/rays`
    max_query_poses: Count | Absent = ABSENT  # in one `q/risk`
    max_query_spheres: Count | Absent = ABSENT  # in one `q/risk`
    max_query_samples: Count | Absent = ABSENT  # steps of all rays of a `q/rays`, cells of a `q/risk`
    max_query_tiles: Count | Absent = ABSENT  # known to the asker of one `q/tiles`


class Info(Message, frozen=True, kw_only=True):
    """What this server is and what it holds."""

    schema: ClassVar[str] = "pot.info.v1"

    server: Identifier  # its id in the key space
    version: str  # of the software
    map: Identifier  # the map that was asked
    maps: list[Identifier]  # all maps of this server
    profile: str  # of the mapper: default or paper
    map_revision: Count  # now
    n_kernels: Count  # in the overall map
    n_atoms: Count  # in the dictionary
    n_scans: Count  # integrated into this map
    lower: Vector3 | None  # m, map frame; bounds of the hinge means, none while the map is empty
    upper: Vector3 | None  # m, map frame
    tile_size_m: Positive  # m, edge of a tile
    observed_activation: Finite  # summed activation of known weights, below which a point is unobserved
    prior_var: Finite  # log-odds^2, of the latent where nothing was observed
    residual_var: Finite  # log-odds^2, added in the measure that this sum falls short of 1
    mean_moderation: Finite = 1.0  # share of the latent variance that pulls the mean towards 0.5
    full_activation: Finite = 0.0  # what a full lattice of known weights sums to; 0: on none
    limits: Limits  # what the server accepts
    started_ns: Sequence  # when the server started
    durable: bool | Absent = ABSENT  # true: accepted clouds survive a crash of the server, false: they do not


class StatsQuery(Message, frozen=True, kw_only=True):
    """`srv/<server>/stats` as a query; an empty payload is taken as this message."""

    schema: ClassVar[str] = "pot.stats_query.v1"


class LatencySummary(msgspec.Struct, frozen=True, kw_only=True):
    """Percentiles over the last window of one kind of work."""

    count: Count  # of measurements in the window
    p50_ms: Measured  # ms; not finite while count is 0
    p95_ms: Measured  # ms
    p99_ms: Measured  # ms
    max_ms: Measured  # ms


class MapScores(msgspec.Struct, frozen=True, kw_only=True):
    """How well a map answers about beams that it set aside and never learned, older ones counting less."""

    n_points: Finite  # what the points asked about count together; each beam gives its end and a point that it crossed
    nll: Measured  # nats a point; not finite before the first
    brier: Measured  # mean squared error of the probability
    ece: Measured  # expected calibration error, 15 bins
    mean_moderation: Finite  # with which the map answers now, chosen by these points


class Stats(Message, frozen=True, kw_only=True):
    """Counters since start, and what the server is doing now: `srv/<server>/stats`, once a second."""

    schema: ClassVar[str] = "pot.stats.v1"

    server: Identifier  # its id in the key space
    stamp_ns: Sequence  # when the counters were read
    uptime_s: Finite  # s
    state: str  # serving | draining | damaged: restart it
    counters: dict[str, Count]  # e.g. clouds.accepted, clouds.rejected.bad_pose, queries.points.ok
    queues: dict[str, Count]  # e.g. clouds.depth, clouds.bytes, queries.depth
    latencies: dict[str, LatencySummary]  # e.g. integrate, points, grid
    rss_bytes: Count  # resident memory of the process
    map_kernels: dict[str, Count]  # kernels per map
    map_scores: dict[str, MapScores] | Absent = ABSENT  # running scores per map


# --- control --------------------------------------------------------------------------------------


class ControlRequest(Message, frozen=True, kw_only=True):
    """`ctl/<verb>`; an empty payload is taken as this message."""

    schema: ClassVar[str] = "pot.control.v1"

    timeout_s: Positive | None = None  # s, past which the work is not begun; absent = no limit
    name: Identifier | Absent = ABSENT  # of a saved map: what to `load` or `merge`, or to `save` a copy as
    robot: Identifier | Absent = ABSENT  # whose scans to `forget`
    T_map_saved: Array | Absent = ABSENT  # (4, 4) float64, rigid; `merge`: absent = the same frame


class ControlReply(Message, frozen=True, kw_only=True):
    """A control verb was carried out."""

    schema: ClassVar[str] = "pot.control_reply.v1"

    verb: str  # as in the key
    map_revision: Count  # afterwards
    message: str  # for people


class ErrorCode(str, Enum):
    """Everything that a client can act on; the code is contract, the text is not."""

    BAD_MESSAGE = "bad_message"  # not MessagePack, truncated, too deep, another schema, wrong fields
    BAD_ARRAY = "bad_array"  # dtype, shape or byte count
    BAD_POSE = "bad_pose"  # not a rigid transform, or not finite
    BAD_POINTS = "bad_points"  # NaN or infinite coordinates
    EMPTY = "empty"  # nothing to do: no points, or none inside the range limits
    TOO_LARGE = "too_large"  # bytes, points or cells beyond the limit
    OUT_OF_RANGE = "out_of_range"  # coordinates beyond what the map can hold
    OLD_STAMP = "old_stamp"  # too far ahead of the server's clock
    OLD_SEQ = "old_seq"  # not above the last accepted cloud of the robot's session
    MAP_FULL = "map_full"  # the map has as many bytes, or robots, as it may
    MAP_DAMAGED = "map_damaged"  # a part of the map that lay on the server's disk cannot be read back
    NO_POSE = "no_pose"  # no pose given, and none to interpolate at the stamp
    UNKNOWN_ROBOT = "unknown_robot"  # not a legal id, or not on the allow list
    UNKNOWN_ATOM = "unknown_atom"  # not in the dictionary
    ATOM_REFUSED = (
        "atom_refused"  # the atom may not join the dictionary; the field `reason` says which rule it breaks
    )
    READ_ONLY = "read_only"  # the server takes no changes of its dictionary, or of anything
    UNSUPPORTED = "unsupported"  # no such operation or verb
    OVERLOADED = "overloaded"  # the queue is full; retry after retry_after_s
    TOO_MANY = "too_many"  # this client asks faster than one may; retry after retry_after_s
    DEADLINE = "deadline"  # the deadline passed before the work could start
    SHUTTING_DOWN = "shutting_down"  # the server takes no more work
    STORAGE = "storage"  # the server's disk did not take it; nothing was changed
    UNKNOWN_MAP = "unknown_map"  # no map was saved under that name
    MAP_FILE = "map_file"  # a saved map that cannot be used; the field `reason` says why
    INTERNAL = "internal"  # a bug of the server; the traceback is in its log


class ErrorReply(Message, frozen=True, kw_only=True):
    """The payload of every `reply_err`."""

    schema: ClassVar[str] = "pot.error.v1"

    code: ErrorCode  # what to act on
    message: str  # for people
    retryable: bool = False  # the same request may succeed later
    retry_after_s: WaitSeconds | None = None  # s, the least useful wait
    reason: str | Absent = ABSENT  # finer than the code where it has several causes, e.g. duplicate


ALL_MESSAGES: tuple[type[Message], ...] = (
    Cloud,
    Pose,
    Kernels,
    Receipt,
    Params,
    Revision,
    PointsQuery,
    Occupancy,
    GridQuery,
    GridPart,
    RaysQuery,
    Rays,
    RiskQuery,
    Risk,
    ParamsQuery,
    ParamsPart,
    TilesQuery,
    TilesPart,
    AtomList,
    Atom,
    AtomsQuery,
    AtomsChanged,
    InfoQuery,
    Info,
    StatsQuery,
    Stats,
    ControlRequest,
    ControlReply,
    ErrorReply,
)

for _kind in ALL_MESSAGES:
    # msgspec builds what it knows of a type at its first use, and crashes when two threads use it first at once
    with suppress(msgspec.ValidationError):
        msgspec.convert({}, _kind)
del _kind
