"""potschemas: the wire contract of potserver. Messages, keys, and bytes; nothing else."""

from potschemas.version import __version__

__all__ = ["__version__"]
