"""Answers about points, which `q/points` and the parts of `q/grid` have in common."""

from __future__ import annotations

import numpy as np

from potschemas import messages, wire
from potserver.codec.base import float32
from potserver.domain.types import Occupancy

# float32 would round a sure answer up to certainty, which costs an infinite log-loss when it is wrong
_BELOW_ONE = float(np.nextafter(np.float32(1), np.float32(0)))


def encode_occupancy(occupancy: Occupancy) -> messages.Occupancy:
    """An answer as its message."""
    return messages.Occupancy(
        mean=float32(np.minimum(occupancy.mean, _BELOW_ONE)),
        var=float32(occupancy.var),
        latent_mean=float32(occupancy.latent_mean),
        latent_var=float32(occupancy.latent_var),
        observed=wire.encode_array(occupancy.observed),
        map_revision=occupancy.map_revision,
        borrowed=float32(occupancy.borrowed) if occupancy.borrowed.any() else messages.ABSENT,
        gradient=messages.ABSENT if occupancy.gradient is None else float32(occupancy.gradient),
        latent_gradient=(
            messages.ABSENT if occupancy.latent_gradient is None else float32(occupancy.latent_gradient)
        ),
    )
