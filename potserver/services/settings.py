"""`MappingSettings`, which lives in `potserver.mapping.settings` now."""

from potserver.mapping.settings import MappingSettings

__all__ = ["MappingSettings"]
