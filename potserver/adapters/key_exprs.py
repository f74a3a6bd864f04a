"""What a received key expression says. A publisher may use wildcards too, and names nobody then."""

from __future__ import annotations

import zenoh

from potschemas import keys


def is_wild(key_expr: zenoh.KeyExpr) -> bool:
    """Whether it stands for more than one key."""
    text = str(key_expr)
    return "*" in text or "$" in text


def sender_of(key_expr: zenoh.KeyExpr) -> str | None:
    """The robot chunk of a key, which may not be a legal id; None if the key is wild or of no robot."""
    if is_wild(key_expr):
        return None
    try:
        return keys.robot_of(str(key_expr))
    except ValueError:
        return None
