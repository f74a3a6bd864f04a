"""potserver: a 3D map server for robots. In process: `KernelMap`, `AtomDictionary`, `MappingService`."""

from potschemas.version import __version__
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.services.mapping import MappingService

__all__ = ["AtomDictionary", "KernelMap", "MappingService", "__version__"]
