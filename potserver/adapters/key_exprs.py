"""What a received key expression says. A publisher may use wildcards too, and names nobody then."""

from __future__ import annotations

import zenoh

from potschemas import keys
from potserver.errors import UnknownRobotError


def is_wild(key_expr: zenoh.KeyExpr) -> bool:
    """Whether it stands for more than one key."""
    text = str(key_expr)
    return "*" in text or "$" in text


def last_chunk(key_expr: zenoh.KeyExpr) -> str:
    """What stands after the last slash: the operation or the verb that is asked for."""
    return str(key_expr).rsplit("/", 1)[-1][:80]


def sender_of(key_expr: zenoh.KeyExpr) -> str | None:
    """The robot chunk of a key, which may not be a legal id; None if the key is wild or of no robot."""
    if is_wild(key_expr):
        return None
    try:
        return keys.robot_of(str(key_expr))
    except ValueError:
        return None


def check_robot_id(robot_id: str, allowed: frozenset[str]) -> None:
    """Refuse robots that have no legal id, or are not on the list; an empty list allows all.

    Raises:
        UnknownRobotError: either of the two.
    """
    try:
        keys.check_id(robot_id, "robot")
    except ValueError as error:
        raise UnknownRobotError(str(error)[:200]) from error
    if allowed and robot_id not in allowed:
        raise UnknownRobotError(f"robot {robot_id!r} is not on the allow list")
