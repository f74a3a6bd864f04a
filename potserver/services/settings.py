"""`MappingSettings`, by the path that scripts outside the project use."""

from potserver.mapping.settings import MappingSettings

__all__ = ["MappingSettings"]
