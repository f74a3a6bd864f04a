"""Packages that only some verbs need, and what to say where one is missing."""

from __future__ import annotations

import importlib.metadata


def how_to_install(extra: str) -> str:
    """The command that brings what an extra needs.

    It names the distribution that is installed here, whose own metadata have the packages: so it works from a checkout, a wheel
    and a release alike.
    """
    return f"pip install '{_distribution()}[{extra}]'"


def _distribution() -> str:
    try:
        importlib.metadata.distribution("potserver")
    except importlib.metadata.PackageNotFoundError:
        return "potclient"
    return "potserver"
