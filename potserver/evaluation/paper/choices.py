"""Tables of what the method chooses: numbers of atoms, rotations, out-of-sample maps, rankings, mass, and what they cost."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from statistics import median

from potserver.domain.dictionary import AtomDictionary
from potserver.evaluation.paper.icp import icp
from potserver.evaluation.paper.mass import MASS
from potserver.evaluation.paper.scenes import Scene
from potserver.evaluation.paper.table import Cell, Found, Lab, Shown, Table, show_rows
from potserver.evaluation.paper.transfer import towns_of
from potserver.evaluation.paper.trial import OurMap, Row, paper_map, run_maps, scans_of
from potserver.mapping.matching import RankScore
from potserver.mapping.paper import PAPER, PotPipeline
from potserver.mapping.pipeline import Method
from potserver.numerics.displacement import OutOfSample

_EVEN = {
    "none": (0.0,),
    "4 of 90 degrees": tuple(90.0 * k for k in range(4)),
    "8 of 45 degrees": PAPER.ranking.rotations_deg,
    "16 of 22.5 degrees": tuple(22.5 * k for k in range(16)),
    "24 of 15 degrees": tuple(15.0 * k for k in range(24)),
}
_SAMPLES = OutOfSample.NEAREST, OutOfSample.LINEAR, OutOfSample.ENTROPIC
_EXACT_REG_M2 = 0.25  # next to none
_MASS_POINTS = 250  # of each side: plain numpy is slow
_MASS_REG = 0.005  # of the largest cost


def _ranked(**changes: object) -> Method:
    return PAPER._replace(ranking=PAPER.ranking._replace(**changes))  # type: ignore[arg-type]


def _coupled(**changes: object) -> Method:
    return PAPER._replace(coupling=PAPER.coupling._replace(**changes))  # type: ignore[arg-type]


def _variant(lab: Lab, name: str, method: Method, atoms: AtomDictionary) -> OurMap:
    return paper_map(name, atoms, partial(PotPipeline, method=method), threads=lab.threads)


def _pairs(lab: Lab) -> list[tuple[Scene, Scene]]:
    """One source and another target, in 2D and in 3D."""
    found = []
    for planar in (True, False):
        towns = towns_of(lab, planar=planar)
        found.append((towns[0], towns[-1]))
    return found


def _variants(lab: Lab, methods: dict[str, Method]) -> list[Cell]:
    """A cell a pair of towns and variant of POT."""
    return [
        Cell(
            f"{source.name} to {target.name}, {name}",
            partial(_run_variant, lab, source, target, name, method),
        )
        for source, target in _pairs(lab)
        for name, method in methods.items()
    ]


def _run_variant(lab: Lab, source: Scene, target: Scene, name: str, method: Method) -> list[Row]:
    mapper = _variant(lab, name, method, lab.sources.of(source))
    rows = run_maps([mapper], scans_of(target, lab.size, lab.data), lab.on_step).rows()
    return [row | _stages(mapper) | _ends(mapper) for row in rows]


def _stages(mapper: OurMap) -> Row:
    """Median ms of the steps of a scan, by the clock on the wall."""
    steps = mapper.updates[0].timings_ms
    return {f"{name}_ms": median(update.timings_ms[name] for update in mapper.updates) for name in steps}


def _ends(mapper: OurMap) -> Row:
    """Sectors that were served, and the iterations of their couplings."""
    sectors = [sector for update in mapper.updates for sector in update.sectors]
    served = [sector for sector in sectors if sector.atom_id is not None]
    return {
        "served": len(served) / max(len(sectors), 1),
        "iterations": median([sector.n_iterations for sector in served] or [0]),
    }


# --- rotations, out of sample, mass: variants one by one -------------------------------------------------------------------


def _rotation_cells(lab: Lab) -> list[Cell]:
    methods = {name: _ranked(rotations_deg=turns) for name, turns in _EVEN.items()}
    aligned = PAPER.sectors._replace(is_aligned=True)
    methods["5 of 15 degrees, sectors turned to their bisector"] = _ranked(
        rotations_deg=(-30.0, -15.0, 0.0, 15.0, 30.0)
    )._replace(sectors=aligned)
    methods["none, sectors turned to their bisector"] = _ranked(rotations_deg=(0.0,))._replace(
        sectors=aligned
    )
    return _variants(lab, methods)


def _sample_cells(lab: Lab) -> list[Cell]:
    return _variants(lab, {kind.value: _coupled(out_of_sample=kind) for kind in _SAMPLES})


def _alignment_cells(lab: Lab) -> list[Cell]:
    rigid = OutOfSample.RIGID
    return _variants(
        lab,
        {
            "transport": PAPER,
            "the transport's rigid part": _coupled(out_of_sample=rigid),
            "ICP": _coupled(out_of_sample=rigid, solve=icp),
        },
    )


def _mass_cells(lab: Lab) -> list[Cell]:
    return _variants(
        lab,
        {
            name: _coupled(n_points=_MASS_POINTS, reg=_MASS_REG, tolerance=1e-3, solve=solve)
            for name, solve in MASS.items()
        },
    )


def _time_cells(lab: Lab) -> list[Cell]:
    regs = (0.004, 0.002, 0.001, 0.0005, 0.00025)
    return _variants(lab, {f"reg {reg:g} of the largest cost": _coupled(reg=reg) for reg in regs})


def _show_times(found: Found) -> list[Shown]:
    lines = []
    for key, rows in found.items():
        for row in rows:
            whole = sum(row[f"{step}_ms"] for step in ("label", "match", "transport", "fuse", "index"))
            share = [row["match_ms"] / whole, row["transport_ms"] / whole]
            cells = [
                row["label_ms"],
                row["match_ms"],
                row["transport_ms"],
                row["fuse_ms"] + row["index_ms"],
                whole,
            ]
            lines.append(
                [key, *(f"{ms:.0f}" for ms in cells), *(f"{part:.0%}" for part in share), f"{row['iterations']:.0f}",
                 f"{row['nll']:.3f}"]
            )  # fmt: skip
    heads = [
        "domains, coupling",
        "labels",
        "ranking",
        "coupling",
        "map",
        "all",
        "share of ranking",
        "of coupling",
    ]
    return [Shown("ms a scan, median", [*heads, "iterations", "NLL"], lines)]


# --- ranking --------------------------------------------------------------------------------------------------------------


def _rank_cells(lab: Lab) -> list[Cell]:
    return [
        Cell(f"{source.name} to {target.name}", partial(_rankings, lab, source, target))
        for source, target in _pairs(lab)
    ]


def _rankings(lab: Lab, source: Scene, target: Scene) -> list[Row]:
    """Scores of the rankings beside each other, and how many choices are those of next to no entropy."""
    atoms = lab.sources.of(source)
    methods = {}
    for score in RankScore:
        sharp = {"tolerance": 1e-2, "max_iterations": 4000}
        methods[f"{score.value}, reg {_EXACT_REG_M2:g} m2"] = _ranked(
            score=score, reg_m2=_EXACT_REG_M2, **sharp
        )
        for reg in (PAPER.ranking.reg_m2, 12.5):
            methods[f"{score.value}, reg {reg:g} m2"] = _ranked(score=score, reg_m2=reg)
    maps = [_variant(lab, name, method, atoms) for name, method in methods.items()]
    run = run_maps(list(maps), scans_of(target, lab.size, lab.data), lab.on_step)
    choices = [
        [
            (s.atom_id, round(s.rotation_rad, 3))
            for update in mapper.updates
            for s in update.sectors
            if s.atom_id
        ]
        for mapper in maps
    ]
    rows = run.rows()
    for number, (row, mine) in enumerate(zip(rows, choices, strict=True)):
        exact = choices[number - number % 3]  # of the same score
        row["same"] = sum(a == b for a, b in zip(mine, exact, strict=False)) / max(len(exact), 1)
    return rows


# --- number of atoms ------------------------------------------------------------------------------------------------------


def _atom_cells(lab: Lab) -> list[Cell]:
    cells = []
    for planar in (True, False):
        *sources, target = towns_of(lab, planar=planar) * (2 if lab.size.towns == 1 else 1)
        for n in lab.size.atoms:
            cells.append(Cell(f"{target.name}, {n} atoms", partial(_of_pool, lab, tuple(sources), target, n)))
    return cells


def _of_pool(lab: Lab, sources: tuple[Scene, ...], target: Scene, n: int) -> list[Row]:
    pool = lab.sources.pool(sources, max(lab.size.atoms)).atoms
    mapper = _variant(lab, "POT", PAPER, AtomDictionary(pool[:n]))
    rows = run_maps([mapper], scans_of(target, lab.size, lab.data), lab.on_step).rows()
    w2 = [sector.w2_m2 for update in mapper.updates for sector in update.sectors if sector.atom_id]
    return [
        row | _stages(mapper) | {"atoms": min(n, len(pool)), "w2_m2": median(w2 or [0.0])} for row in rows
    ]


def _plain(*extra: tuple[str, str, str]) -> Callable[[Found], list[Shown]]:
    return lambda found: show_rows(found, *extra)


_NO_FIGURE = "The paper has no figure of this."
CHOICES = (
    Table(
        "runtime", "Run time of POT and its shares", "The paper says 1 s a scan in Python on 4 cores, "
        "not parallel, and that time grows with lambda = 1 / reg; its atoms have a few hundred points, as ours.", "20",
        _time_cells, _show_times,
    ),
    Table(
        "atoms", "Number of atoms", _NO_FIGURE + " It says that more kernels learned before help.", "120", _atom_cells,
        _plain(("W2, m2", "w2_m2", ".1f"), ("ranking ms", "match_ms", ".0f")), x="atoms",
    ),
    Table("rotations", "Rotations of the atom", _NO_FIGURE + " It rotates in a discrete set; its code in 8 steps.", "30",
          _rotation_cells, _plain(("ranking ms", "match_ms", ".0f"))),
    Table("out-of-sample", "Out-of-sample maps", _NO_FIGURE + " It says linear, its code takes nearest.",
          "20", _sample_cells, _plain(("sectors served", "served", ".0%"))),
    Table("alignment", "Transport and rigid alignment", _NO_FIGURE + " It says that ICP, unlike transport, takes no large and"
          " non-rigid change.", "20", _alignment_cells, _plain(("sectors served", "served", ".0%"))),
    Table("ranking", "Scores of the ranking", _NO_FIGURE + " Eq. 7 is `w2`, its code does `normalised` at 12.5 m2.", "20",
          _rank_cells, _plain(("same choice as without blur", "same", ".0%"))),
    Table("mass", "Balanced, unbalanced and partial transport", _NO_FIGURE + " It is balanced.", "40", _mass_cells,
          _plain(("sectors served", "served", ".0%"), ("coupling ms", "transport_ms", ".0f"))),
)  # fmt: skip
