"""potschemas: the wire contract of potserver. Messages, keys, bytes, and what kernels answer."""

from potschemas.version import __version__

__all__ = ["__version__"]
