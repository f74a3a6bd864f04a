"""One fixed example of every message and of its edge cases: what the golden vectors are made of.

The numbers are exact in binary, so that the readable form shows what the bytes hold.
"""

from __future__ import annotations

import math
import zlib

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from potschemas import messages as m
from potschemas.wire import encode_array

_STAMP_NS = 1_700_000_000_000_000_000


def examples() -> dict[str, m.Message]:
    """Messages by name: the schema, and after one more dot the variant, as in `pot.cloud.v1.planar`."""
    named: dict[str, m.Message] = {}

    def add(message: m.Message, variant: str = "") -> None:
        named[f"{message.schema}.{variant}" if variant else message.schema] = message

    points = _f4([[4.0, 0.5, -0.25], [3.5, -1.0, 0.0], [60.0, 0.0, 1.5]])
    add(
        m.Cloud(
            seq=7,
            stamp_ns=_STAMP_NS,
            points=points,
            T_map_sensor=_pose(12.0, -3.5, 1.75),
            is_return=_bool([True, True, False]),
            robot="r1",
        )
    )
    add(m.Cloud(seq=0, stamp_ns=0, points=points), "minimal")
    add(m.Cloud(seq=8, stamp_ns=_STAMP_NS, points=_f4([[4.0, 0.5], [3.5, -1.0]])), "planar")
    add(m.Cloud(seq=9, stamp_ns=_STAMP_NS, points=points, is_return=_bool([False] * 3)), "no_return")
    add(m.Cloud(seq=2**63 - 1, stamp_ns=2**63 - 1, points=_f4(np.zeros((0, 3)))), "no_points")
    add(m.Cloud(seq=10, stamp_ns=0, points=points, params=m.ParamsKind.TRANSPORTED), "params")
    add(m.Pose(stamp_ns=_STAMP_NS, T_map_sensor=_pose(12.0, -3.5, 1.75)))

    kernels, no_kernels = _kernels(2), _kernels(0)
    add(kernels)
    add(no_kernels, "empty")
    add(_kernels(1, origin=[500_000.0, 5_400_000.0, 250.5]), "far_origin")
    add(msgspec.structs.replace(no_kernels, lean=_lean()), "lean")
    add(msgspec.structs.replace(no_kernels, lean=_lean(), nodes=_nodes()), "nodes")

    served = m.SectorReport(
        azimuth_min_rad=-0.5,
        azimuth_max_rad=0.75,
        n_hits=420,
        n_free=1260,
        atom_id="street-corner-03",
        rotation_rad=0.125,
        w2_m2=0.375,
        n_kernels=2,
        converged=True,
        marginal_error=2.0**-20,
        n_iterations=64,
    )
    left_out = m.SectorReport(
        azimuth_min_rad=0.75,
        azimuth_max_rad=2.0,
        n_hits=3,
        n_free=0,
        atom_id=None,
        rotation_rad=math.nan,
        w2_m2=math.inf,
        n_kernels=0,
        converged=False,
        marginal_error=math.nan,
        n_iterations=0,
        reason="too few echoes",
    )
    add(
        m.Receipt(
            map="default",
            robot="r1",
            seq=7,
            status=m.ReceiptStatus.ACCEPTED,
            queue_depth=1,
            wait_ms=0.5,
            integrate_ms=48.25,
            map_revision=31,
            n_points=3,
            n_kernels=2,
            n_kernels_added=1,
            n_kernels_transported=1,
            map_kernels=5120,
            sectors=[served, left_out],
            kernels=kernels,
        )
    )
    add(
        m.Receipt(
            map="default",
            robot="r1",
            seq=8,
            status=m.ReceiptStatus.DROPPED,
            reason=m.ErrorCode.OVERLOADED.value,
            message="4 clouds are waiting",
            queue_depth=4,
            map_revision=31,
        ),
        "dropped",
    )
    add(
        m.Receipt(
            map="default",
            robot="Robot 1",
            seq=-1,
            status=m.ReceiptStatus.REJECTED,
            reason=m.ErrorCode.BAD_MESSAGE.value,
            message="pot.cloud.v1: truncated after 17 bytes",
            map_revision=31,
        ),
        "rejected",
    )
    add(m.Cloud(seq=8, stamp_ns=_STAMP_NS, points=points, robot="r1", session="5f0c9a1e22b4d7c3"), "session")
    add(
        m.Receipt(
            map="default",
            robot="r1",
            seq=8,
            status=m.ReceiptStatus.REJECTED,
            reason=m.ErrorCode.OLD_SEQ.value,
            message="cloud 8 of r1 is not above 12",
            map_revision=31,
            next_seq=13,
        ),
        "old_seq",
    )
    params = m.Params(
        map="default",
        robot="r1",
        seq=7,
        stamp_ns=_STAMP_NS,
        map_revision=31,
        kernels=kernels,
        sectors=[served],
    )
    add(params)
    add(
        m.Params(map="default", robot="r1", seq=8, stamp_ns=_STAMP_NS, map_revision=31, kernels=no_kernels),
        "empty",
    )
    fitted = msgspec.structs.replace(no_kernels, lean=_lean(), nodes=_nodes())
    borrowed = [
        m.Borrowed(
            name="expectation", weight=1.0, displacement=[12.0, -3.5, 0.0], slope=[0.0, 0.015625], scale=1.0
        )
    ]
    add(msgspec.structs.replace(params, kernels=fitted, sectors=[], borrowed=borrowed), "fitted")
    add(
        m.Receipt(
            map="default",
            robot="r1",
            seq=7,
            status=m.ReceiptStatus.ACCEPTED,
            n_kernels=2,
            kernels=fitted,
            borrowed=borrowed,
        ),
        "fitted",
    )
    add(
        m.Revision(
            map="default",
            map_revision=31,
            stamp_ns=_STAMP_NS,
            n_kernels=5120,
            tile_size_m=8.0,
            changed_tiles=[[0, -1, 0], [2, -1, 0]],
        )
    )
    add(
        m.Revision(
            map="default", map_revision=32, stamp_ns=_STAMP_NS, n_kernels=0, tile_size_m=8.0, changed_tiles=[]
        ),
        "no_tiles",
    )

    add(m.PointsQuery(points=_f4([[1.0, 2.0, 0.5], [-3.0, 0.25, 0.5]]), deadline_ms=250.0))
    add(m.PointsQuery(points=_f8([[500_000.25, 5_400_000.5]])), "planar_float64")
    add(m.PointsQuery(points=_f4([[1.0, 2.0, 0.5]]), with_gradient=True), "gradient")
    add(m.PointsQuery(points=_f4([[1.0, 2.0, 0.5]]), evidence_only=True), "evidence_only")
    occupancy = m.Occupancy(
        mean=_f4([0.875, 0.5]),
        var=_f4([0.015625, 0.25]),
        latent_mean=_f4([2.5, 0.0]),
        latent_var=_f4([0.75, 64.0]),
        observed=_bool([True, False]),
        map_revision=31,
    )
    none = _f4(np.zeros(0))
    add(occupancy)
    add(
        m.Occupancy(
            mean=_f4([0.875, 0.5]),
            var=_f4([0.015625, 0.25]),
            latent_mean=_f4([2.5, 0.0]),
            latent_var=_f4([0.75, 64.0]),
            observed=_bool([True, False]),
            map_revision=31,
            gradient=_f4([[0.25, -0.125, 0.0], [0.0, 0.0, 0.0]]),
            latent_gradient=_f4([[2.5, -1.25, 0.0], [0.0, 0.0, 0.0]]),
        ),
        "gradient",
    )
    add(
        m.Occupancy(
            mean=_f4([0.875, 0.125]),
            var=_f4([0.015625, 0.0625]),
            latent_mean=_f4([2.5, -3.0]),
            latent_var=_f4([0.75, 64.0]),
            observed=_bool([True, False]),
            map_revision=31,
            borrowed=_f4([0.25, 1.0]),
        ),
        "borrowed",
    )
    add(
        m.Occupancy(
            mean=none, var=none, latent_mean=none, latent_var=none, observed=_bool([]), map_revision=0
        ),
        "no_points",
    )
    add(m.GridQuery(lower=[-1.0, -1.0, 0.0], upper=[1.0, 1.0, 0.5], resolution=0.25, deadline_ms=1000.0))
    add(
        m.GridQuery(lower=[0.0, 0.0, 0.0], upper=[1.0, 1.0, 0.5], resolution=0.25, evidence_only=True),
        "evidence_only",
    )
    add(m.GridQuery(lower=[-1.0, -1.0, 0.0], upper=[1.0, 1.0, 0.5], resolution=0.25), "minimal")
    add(
        m.GridPart(
            part=1,
            n_parts=64,
            shape=[8, 8, 2],
            first_cell=2,
            lower=[-1.0, -1.0, 0.0],
            resolution=0.25,
            occupancy=occupancy,
        )
    )
    rays = _f4([[1.0, 2.0, 0.5], [1.0, 2.0, 0.5]])
    ways = _f4([[1.0, 0.0, 0.0], [0.0, -0.5, 0.5]])
    add(
        m.RaysQuery(
            origins=rays,
            directions=ways,
            max_range_m=25.0,
            quantiles=[0.25, 0.5],
            unknown=m.Unknown.FREE,
            width_m=0.5,
            step_m=0.125,
            deadline_ms=500.0,
        )
    )
    add(m.RaysQuery(origins=rays, directions=ways, max_range_m=25.0), "minimal")
    add(m.RaysQuery(origins=rays, directions=ways, max_range_m=25.0, evidence_only=True), "evidence_only")
    returns = m.Rays(
        hit_probability=_f4([0.96875, 0.25]),
        mean_m=_f4([7.5, 21.25]),
        std_m=_f4([0.375, 6.5]),
        quantile_m=_f4([[7.25, 7.5], [25.0, 25.0]]),
        unknown_range_m=_f4([math.nan, 8.0]),
        unknown_share=_f4([0.0, 0.625]),
        step_m=0.125,
        map_revision=31,
    )
    add(returns)
    add(msgspec.structs.replace(returns, borrowed_share=_f4([0.0, 0.5])), "borrowed")
    path = _f8(
        [
            [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, 0.25], [0.0, 0.0, 0.0, 1.0]]
            for x in (1.0, 1.5)
        ]
    )
    body = _f4([[0.25, 0.0, 0.25, 0.5], [-0.25, 0.0, 0.25, 0.5]])
    add(
        m.RiskQuery(
            path=path,
            spheres=body,
            unknown=m.Unknown.PRIOR,
            resolution_m=0.125,
            correlation_m=0.5,
            dims=2,
            deadline_ms=500.0,
        )
    )
    add(m.RiskQuery(path=path, spheres=body), "minimal")
    add(m.RiskQuery(path=path, spheres=body, evidence_only=True), "evidence_only")
    risk = m.Risk(
        max_probability=_f4([0.0625, 0.75]),
        union_probability=_f4([0.125, 0.875]),
        unknown_share=_f4([0.0, 0.25]),
        path_max_probability=0.75,
        path_union_probability=0.9375,
        path_unknown_share=0.125,
        n_cells=640,
        resolution_m=0.125,
        map_revision=31,
    )
    add(risk)
    add(msgspec.structs.replace(risk, borrowed_share=_f4([0.0, 0.25]), path_borrowed_share=0.125), "borrowed")
    add(m.ParamsQuery(lower=[-8.0, -8.0, -2.0], upper=[8.0, 8.0, 4.0], deadline_ms=1000.0))
    add(m.ParamsQuery(), "whole_map")
    add(m.ParamsPart(part=0, n_parts=2, map_revision=31, kernels=kernels))
    add(m.ParamsPart(part=0, n_parts=1, map_revision=0, kernels=no_kernels), "empty")

    add(
        m.TilesQuery(
            lower=[-8.0, -8.0, -2.0],
            upper=[8.0, 8.0, 4.0],
            epoch=2**62 + 1,
            known=_packed(np.array([[0, -1], [-1, -1], [0, 0], [30, 7]], np.int64)),
            deadline_ms=1000.0,
        )
    )
    add(m.TilesQuery(step=0.0625), "in_steps")
    add(m.TilesQuery(), "whole_map")
    add(_tiles_part())
    add(_tiles_part(deflated=True), "deflated")
    add(msgspec.structs.replace(_tiles_part(), lean=_lean()), "lean")
    add(
        msgspec.structs.replace(
            _tiles_part(),
            n_parts=1,
            counts=_packed(np.array([0, 3], np.int64)),
            changes=m.TileChanges(
                step=0.0625,
                var_step=0.1875,
                var_unit=100.0,
                based=_packed(np.array([True, False])),
                lattices=[
                    m.LatticeNodes(
                        shape=_packed(np.array([0.0625, 0.0625, 0.0625, 8.0, 4.0], np.float32)),
                        spacing=0.5,
                        offset=[0.25, 0.25, 0.25],
                        cells=[16, 16, 16],
                        tiles=_packed(np.array([0, 1], np.int64)),
                        toggled=_packed(np.array([18, 1, 4096], np.int64)),  # nodes 17, 18 and 4114
                        mean_changes=_packed(np.array([4, 1, 0], np.int64)),  # 2, -1, 0
                        var_changes=_packed(np.array([0, 3, 0], np.int64)),  # 0, -2, 0
                        new_means=_packed(np.array([96, 63], np.int64)),  # 48, -32
                        new_vars=_packed(np.array([37, 0], np.int64)),  # -19, 0
                    )
                ],
            ),
        ),
        "in_steps",
    )
    add(
        msgspec.structs.replace(
            _tiles_part(),
            n_parts=1,
            whole=True,
            gone=None,
            kernels=m.CodedKernels(
                kinds=_packed(np.array([[0.0625, 0.5]] * 3 + [[8.0, 9.0], [4.0, 4.0]], np.float32)),
                lattices=_packed(np.zeros((4, 2))),
                cells=_packed(np.zeros((3, 0), np.uint8)),
                hinge_mean=_packed(np.array([[0.5, 7.0], [1.5, 7.25], [2.0, 7.5]], np.float32)),
                weight_mean=_packed(np.array([3.0, -2.0], np.float32)),
                weight_var=_packed(np.array([0.5, 0.25], np.float32)),
            ),
        ),
        "plain",
    )
    add(
        msgspec.structs.replace(
            _tiles_part(),
            n_parts=1,
            tiles=_packed(np.zeros((4, 0), np.int64)),
            counts=_packed(np.zeros(0, np.int64)),
            gone=None,
            kernels=m.CodedKernels(
                kinds=_packed(np.zeros((5, 0), np.float32)),
                lattices=_packed(np.zeros((4, 0))),
                cells=_packed(np.zeros((3, 0), np.uint8)),
                hinge_mean=_packed(np.zeros((3, 0), np.float32)),
                weight_mean=_packed(np.zeros(0, np.float32)),
                weight_var=_packed(np.zeros(0, np.float32)),
            ),
        ),
        "nothing_changed",
    )

    info = m.AtomInfo(
        atom_id="street-corner-03",
        dims=3,
        n_hits=2,
        n_free=1,
        n_kernels=2,
        radius_m=20.0,
        azimuth_width_rad=1.25,
        times_used=17,
        provenance={"licence": "MIT", "source": "generated town 3"},
    )
    atom = m.Atom(
        info=info,
        hit_points=_f4([[5.0, 0.5, 0.0], [5.0, -0.5, 1.0]]),
        free_points=_f4([[2.5, 0.0, 0.5]]),
        kernels=kernels,
    )
    add(m.AtomsQuery(atom_id="street-corner-03"))
    add(m.AtomsQuery(), "list")
    add(m.AtomsQuery(action=m.AtomsAction.ADD, atom=atom), "add")
    add(m.AtomsQuery(action=m.AtomsAction.REMOVE, atom_id="street-corner-03"), "remove")
    add(m.AtomList(atoms=[info]))
    add(m.AtomList(atoms=[]), "empty")
    yard = m.PlaceInfo(name="yard", times_used=12, provenance={"scans": "40", "held_out_nll": "0.1875"})
    add(m.AtomList(atoms=[], places=[yard]), "places")
    add(atom)
    add(m.AtomsChanged(atom_id="street-corner-03", n_atoms=33, persisted=True))
    add(m.AtomsChanged(atom_id="street-corner-03", n_atoms=32, persisted=False), "in_memory")

    add(m.InfoQuery())
    limits = m.Limits(
        max_cloud_bytes=8 * 2**20,
        max_cloud_points=300_000,
        max_query_bytes=2**20,
        max_query_points=1_000_000,
        max_grid_cells=20_000_000,
        max_range_m=120.0,
        max_coordinate_m=1_000_000.0,
    )
    add(_info(limits, lower=[-40.0, -32.5, -2.0], upper=[88.0, 64.0, 6.5], n_scans=31))
    add(_info(limits, lower=None, upper=None, n_scans=0), "empty_map")
    kept = _info(limits, lower=None, upper=None, n_scans=0)
    add(msgspec.structs.replace(kept, durable=True), "durable")
    ray_limits = msgspec.structs.replace(
        limits,
        max_query_rays=50_000,
        max_query_poses=5_000,
        max_query_spheres=256,
        max_query_samples=4_000_000,
    )
    add(_info(ray_limits, lower=[-40.0, -32.5, -2.0], upper=[88.0, 64.0, 6.5], n_scans=31), "ray_limits")
    tile_limits = msgspec.structs.replace(ray_limits, max_query_tiles=100_000)
    add(_info(tile_limits, lower=[-40.0, -32.5, -2.0], upper=[88.0, 64.0, 6.5], n_scans=31), "tile_limits")
    add(m.StatsQuery())
    add(
        m.Stats(
            server="s1",
            stamp_ns=_STAMP_NS,
            uptime_s=12.5,
            state="serving",
            counters={"clouds.accepted": 31, "clouds.received": 32, "clouds.rejected.bad_pose": 1},
            queues={"clouds.bytes": 480_000, "clouds.depth": 1},
            latencies={
                "integrate": m.LatencySummary(count=31, p50_ms=48.0, p95_ms=61.5, p99_ms=70.25, max_ms=72.0)
            },
            rss_bytes=700_000_000,
            map_kernels={"default": 5120},
            map_scores={
                "default": m.MapScores(n_points=812.5, nll=0.05, brier=0.01, ece=0.008, mean_moderation=0.025)
            },
        )
    )
    unmeasured = m.LatencySummary(count=0, p50_ms=math.nan, p95_ms=math.nan, p99_ms=math.nan, max_ms=math.nan)
    add(
        m.Stats(
            server="s1",
            stamp_ns=_STAMP_NS,
            uptime_s=0.0,
            state="draining",
            counters={},
            queues={},
            latencies={"points": unmeasured},
            rss_bytes=0,
            map_kernels={},
        ),
        "idle",
    )

    add(m.ControlRequest(timeout_s=5.0))
    add(m.ControlRequest(), "minimal")
    add(m.ControlRequest(name="before-the-rain"), "name")
    add(m.ControlRequest(name="north-wing", T_map_saved=encode_array(np.eye(4))), "merge")
    add(m.ControlRequest(robot="rover-1"), "forget")
    add(m.ControlReply(verb="clear", map_revision=32, message="5120 kernels removed"))
    add(m.ErrorReply(code=m.ErrorCode.BAD_POSE, message="the pose has NaN or infinite entries"))
    add(
        m.ErrorReply(
            code=m.ErrorCode.OVERLOADED, message="the queue is full", retryable=True, retry_after_s=0.25
        ),
        "retry",
    )
    add(
        m.ErrorReply(
            code=m.ErrorCode.ATOM_REFUSED,
            message="it is a near duplicate of 'street-corner-02'",
            reason="duplicate",
        ),
        "reason",
    )
    return named


def _f4(values: ArrayLike) -> m.Array:
    return encode_array(np.asarray(values, np.float32))


def _f8(values: ArrayLike) -> m.Array:
    return encode_array(np.asarray(values, np.float64))


def _packed(array: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> m.Packed:
    """As `wire.pack_array`, but stored and not deflated: compressors may differ, the examples may not."""
    wire = encode_array(array)
    planes = np.frombuffer(wire.data, np.uint8).reshape(-1, array.itemsize).T.tobytes()
    n = len(planes)
    stored = b"\x01" + n.to_bytes(2, "little") + (n ^ 0xFFFF).to_bytes(2, "little") + planes
    stream = b"\x78\x01" + stored + zlib.adler32(planes).to_bytes(4, "big")
    return m.Packed(dtype=wire.dtype, shape=wire.shape, deflated=stream)


def _tiles_part(*, deflated: bool = False) -> m.TilesPart:
    """Two tiles of a map with kernels of 0.5 m on a lattice, and one kernel that is on none."""
    counts = _packed(np.array([2, 1], np.int64))
    if deflated:  # the same, as a compressor gave it
        counts = m.Packed(dtype=m.DType.INT64, shape=[2], deflated=bytes.fromhex("78da636264400100003f0004"))
    return m.TilesPart(
        part=0,
        n_parts=2,
        epoch=2**62 + 1,
        map_revision=31,
        whole=False,
        tile_size_m=8.0,
        tiles=_packed(np.array([[0, 1], [-1, -1], [0, 0], [31, 31]], np.int64)),
        counts=counts,
        gone=_packed(np.array([[-1], [-1], [0]], np.int64)),
        kernels=m.CodedKernels(
            kinds=_packed(np.array([[0.0625, 0.5]] * 3 + [[8.0, 9.0], [4.0, 4.0]], np.float32)),
            lattices=_packed(np.array([[0.5, 0.0], [0.25, 0.0], [0.25, 0.0], [0.25, 0.0]])),
            kind=_packed(np.array([0, 1, 0], np.uint8)),
            cells=_packed(np.array([[0, 15], [1, 2], [4, 4]], np.uint8)),
            hinge_mean=_packed(np.array([[7.125], [0.75], [2.5]], np.float32)),
            weight_mean=_packed(np.array([3.0, -2.0, 1.5], np.float32)),
            weight_var=_packed(np.array([0.5, 0.25, 0.125], np.float32)),
        ),
        observed_activation=0.125,
        prior_var=64.0,
        residual_var=32.0,
        mean_moderation=0.0625,
    )


def _lean() -> m.Lean:
    """A tile whose lower half is likely occupied."""
    nodes = np.full((1, 2, 2, 3), 64, np.uint8)
    nodes[..., 0] = 176
    return m.Lean(
        tile_size_m=8.0,
        tiles=_packed(np.array([[0], [-1], [0], [31]], np.int64)),
        nodes=_packed(nodes),
    )


def _nodes() -> m.TileChanges:
    """Two kernels of 0.5 m on a lattice."""
    none = _packed(np.zeros(0, np.int64))
    lattice = m.LatticeNodes(
        shape=_packed(np.array([0.0625, 0.0625, 0.0625, 8.0, 4.0], np.float32)),
        spacing=0.5,
        offset=[0.25, 0.25, 0.25],
        cells=[16, 16, 16],
        tiles=_packed(np.zeros(1, np.int64)),
        toggled=_packed(np.array([18, 1], np.int64)),  # nodes 17 and 18
        mean_changes=none,
        var_changes=none,
        new_means=_packed(np.array([24, 15], np.int64)),  # 12, -8
        new_vars=_packed(np.array([5, 0], np.int64)),  # -3, 0
    )
    return m.TileChanges(
        step=0.25, var_step=0.75, var_unit=64.0, based=_packed(np.array([False])), lattices=[lattice]
    )


def _bool(values: list[bool]) -> m.Array:
    return encode_array(np.asarray(values, np.bool_))


def _pose(x_m: float, y_m: float, z_m: float) -> m.Array:
    """A quarter turn to the left, which is exact."""
    return _f8([[0.0, -1.0, 0.0, x_m], [1.0, 0.0, 0.0, y_m], [0.0, 0.0, 1.0, z_m], [0.0, 0.0, 0.0, 1.0]])


def _kernels(k: int, origin: list[float] | None = None) -> m.Kernels:
    i = np.arange(k)
    return m.Kernels(
        origin=origin or [0.0, 0.0, 0.0],
        hinge_mean=_f4(np.stack([i + 0.5, 2.0 - i, 0.25 * i], axis=1)),
        hinge_var=_f4(np.full((k, 3), 0.0625)),
        gamma_shape=_f4(8.0 + i),
        gamma_rate=_f4(np.full(k, 4.0)),
        weight_mean=_f4(3.0 - 5.0 * i),
        weight_var=_f4(np.full(k, 0.5)),
        observed_activation=0.125,
        prior_var=64.0,
        residual_var=32.0,
        mean_moderation=0.0625,
    )


def _info(limits: m.Limits, *, lower: list[float] | None, upper: list[float] | None, n_scans: int) -> m.Info:
    return m.Info(
        server="s1",
        version="0.1.0",
        map="default",
        maps=["default", "site-b"],
        profile="default",
        map_revision=n_scans,
        n_kernels=5120 if n_scans else 0,
        n_atoms=12,
        n_scans=n_scans,
        lower=lower,
        upper=upper,
        tile_size_m=8.0,
        observed_activation=0.125,
        prior_var=64.0,
        residual_var=32.0,
        mean_moderation=0.0625,
        limits=limits,
        started_ns=_STAMP_NS,
    )
