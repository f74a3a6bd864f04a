"""potserver: a 3D map server for robots. In process: `MappingService` takes a `Scan`, `KernelMap` answers."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from potschemas.version import __version__

if TYPE_CHECKING:
    from potserver.domain.dictionary import AtomDictionary
    from potserver.domain.kernel_map import KernelMap
    from potserver.domain.types import Scan
    from potserver.mapping.service import MappingService
    from potserver.mapping.settings import MappingSettings

__all__ = ["AtomDictionary", "KernelMap", "MappingService", "MappingSettings", "Scan", "__version__"]

_MODULES = {
    "AtomDictionary": "potserver.domain.dictionary",
    "KernelMap": "potserver.domain.kernel_map",
    "MappingService": "potserver.mapping.service",
    "MappingSettings": "potserver.mapping.settings",
    "Scan": "potserver.domain.types",
}


def __getattr__(name: str) -> Any:
    """Load a name at its first use: the command's help needs none of the numerics."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
