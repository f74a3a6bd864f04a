"""Other maps, under the same protocol: what ours is held to. The server needs none of them."""

from __future__ import annotations

from collections.abc import Callable

from potserver.errors import SettingsError
from potserver.evaluation.mappers import Mapper
from potserver.evaluation.peers.bgk import BgkMap
from potserver.evaluation.peers.grid import GridMap
from potserver.evaluation.peers.octomap import OctoMap

_DEFAULT_RESOLUTION_M = 0.1
_WITH_RESOLUTION: dict[str, Callable[[float], Mapper]] = {
    "octomap": OctoMap,
    "bgk": BgkMap,
    "bgk-gap": lambda resolution_m: BgkMap(resolution_m, gap_m=0.5),
}


def peer_named(text: str, *, threads: int) -> Mapper:
    """A peer from what the command line says: `octomap[:M]`, `bgk[:M]`, `bgk-gap[:M]` with a resolution in m, or `grid`.

    Raises:
        SettingsError: no such peer, a resolution that is none, or a library that is not installed.
    """
    name, _, resolution = text.partition(":")
    if name == "grid" and not resolution:
        return GridMap(threads=threads)
    if name not in _WITH_RESOLUTION:
        raise SettingsError(
            f"no peer {text!r}; there are octomap:METRES, bgk:METRES, bgk-gap:METRES and grid"
        )
    try:
        edge_m = float(resolution) if resolution else _DEFAULT_RESOLUTION_M
    except ValueError:
        raise SettingsError(f"peer {text!r}: {resolution!r} is not a number of metres") from None
    if not 0.01 <= edge_m <= 10.0:
        raise SettingsError(f"peer {text!r}: need a resolution between 0.01 and 10 m")
    return _WITH_RESOLUTION[name](edge_m)
