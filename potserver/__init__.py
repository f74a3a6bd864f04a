"""potserver: a 3D map server for robots. In process: `MappingService` takes a `Scan`, `KernelMap` answers."""

from potschemas.version import __version__
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Scan
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings

__all__ = ["AtomDictionary", "KernelMap", "MappingService", "MappingSettings", "Scan", "__version__"]
