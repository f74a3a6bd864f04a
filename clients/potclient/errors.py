"""Everything the client raises on purpose: the server's errors under the server's own names, and the client's own."""

from __future__ import annotations

from potschemas import messages
from potschemas.messages import ABSENT, ErrorCode, ErrorReply
from potschemas.redaction import redacted


class PotclientError(Exception):
    """Base of all expected errors; `retryable` says whether the same call may succeed later. Texts hold no secrets."""

    retryable: bool = False
    retry_after_s: float | None = None

    def __str__(self) -> str:
        return str(redacted(super().__str__()))


# --- the client's own --------------------------------------------------------------------------------------------------------


class NoServerError(PotclientError):
    """Nobody serves this map here: no connection, no server behind it, or one that is still warming up."""

    retryable = True


class AccessError(PotclientError):
    """Somebody is there and does not let this client in: its certificate, its password, or the kind of connection is wrong."""


class QueryTimeoutError(PotclientError, TimeoutError):
    """A server took the question and did not answer in time, or a wait ended before its condition held."""

    retryable = True


class LostReplyError(PotclientError):
    """A server is there and the question got no answer at all: denied, cut off by a size filter, or it died on the way."""

    retryable = True


class IncompleteReplyError(PotclientError):
    """A streamed reply misses parts, repeats them, or mixes revisions of the map."""

    retryable = True


class BadReplyError(PotclientError):
    """The reply is not the message that the contract promises: versions differ, or something else answers on this key."""


class ClosedError(PotclientError):
    """The client is closed."""


class DatasetError(PotclientError):
    """A recording is missing, damaged, or not in the format it was opened as."""


class RosMessageError(PotclientError):
    """A ROS message cannot be used: its bytes are damaged, or what they say is not a scan or a pose. `reason` is one word."""

    def __init__(self, message: str, *, reason: str = "bad_message") -> None:
        super().__init__(message)
        self.reason = reason


class NoTransformError(PotclientError):
    """No pose at the stamp that was asked for; the message names the frames and what is missing between them."""

    def __init__(self, message: str, *, may_come: bool) -> None:
        super().__init__(message)
        self.may_come = may_come  # a later message may bring it


class UsageError(PotclientError):
    """A setting or an argument is not usable; nothing was sent."""


# --- the server's ------------------------------------------------------------------------------------------------------------


class MapServerError(PotclientError):
    """The server refused. `code` is contract (`potschemas.messages.ErrorCode`), the text is for people."""

    code: str = "internal"
    reason: str | None = None  # finer than the code, where it has several causes
    receipt: messages.Receipt | None = None  # set where the refusal was a receipt of `MapClient.integrate`

    def __init__(
        self, message: str, *, retryable: bool | None = None, retry_after_s: float | None = None
    ) -> None:
        super().__init__(message)
        if retryable is not None:
            self.retryable = retryable
        self.retry_after_s = retry_after_s


class BadMessageError(MapServerError):
    """The bytes were not the message that the key promises."""

    code = "bad_message"


class ShapeError(MapServerError):
    """An array had the wrong shape, dtype or byte count."""

    code = "bad_array"


class BadPoseError(MapServerError):
    """A pose is not a rigid transform, or not finite."""

    code = "bad_pose"


class BadPointsError(MapServerError):
    """Coordinates are NaN or infinite."""

    code = "bad_points"


class EmptyError(MapServerError):
    """Nothing to do: no points at all, or none inside the range limits."""

    code = "empty"


class TooLargeError(MapServerError):
    """Bytes, points or cells beyond the server's limit."""

    code = "too_large"


class OutOfRangeError(MapServerError):
    """Coordinates beyond what the map may hold."""

    code = "out_of_range"


class OldSequenceError(MapServerError):
    """The cloud's number is not above the last one that was taken of its session; the message says what would be taken."""

    code = "old_seq"


class MapFullError(MapServerError):
    """The map has as many bytes, or robots, as it may: clear it, forget a robot, or ask the operator."""

    code = "map_full"


class MapDamagedError(MapServerError):
    """The server's disk cannot read back a part of the map; its restart reads what was acknowledged."""

    code = "map_damaged"


class OldStampError(MapServerError):
    """The stamp is not newer than the last accepted cloud of this robot."""

    code = "old_stamp"


class NoPoseError(MapServerError):
    """The cloud has no pose, and the pose stream has none at its stamp."""

    code = "no_pose"


class UnknownRobotError(MapServerError):
    """The robot's id is not legal, or not on the server's allow list."""

    code = "unknown_robot"


class UnknownAtomError(MapServerError):
    """No atom of this id in the dictionary."""

    code = "unknown_atom"


class AtomRefusedError(MapServerError):
    """The atom may not join the dictionary; `reason` says which rule it breaks, e.g. `taken_id`, `duplicate`, `unexplained`."""

    code = "atom_refused"


class ReadOnlyError(MapServerError):
    """The server takes no changes of its dictionary, or was started to take nothing in at all."""

    code = "read_only"


class UnsupportedError(MapServerError):
    """No such operation or verb."""

    code = "unsupported"


class OverloadedError(MapServerError):
    """The server's queue is full; try again after `retry_after_s`."""

    code = "overloaded"
    retryable = True


class TooManyError(MapServerError):
    """This client asks faster than one may; try again after `retry_after_s`, with more in a question."""

    code = "too_many"
    retryable = True


class DeadlineError(MapServerError):
    """The deadline passed before the server could start."""

    code = "deadline"
    retryable = True


class ShuttingDownError(MapServerError):
    """The server takes no more work."""

    code = "shutting_down"
    retryable = True


class StorageError(MapServerError):
    """The server's disk did not take it, and nothing was changed."""

    code = "storage"
    retryable = True


class UnknownMapError(MapServerError):
    """No map was saved under this name."""

    code = "unknown_map"


class MapFileError(MapServerError):
    """A saved map cannot be used; `reason` says why: `damaged`, `version`, `settings`."""

    code = "map_file"


class InternalError(MapServerError):
    """A bug of the server; the traceback is in its log."""

    code = "internal"


ERROR_CLASSES: dict[str, type[MapServerError]] = {cls.code: cls for cls in MapServerError.__subclasses__()}


def error_from_code(
    code: str | None, message: str, *, retryable: bool | None = None, retry_after_s: float | None = None
) -> MapServerError:
    """The exception for an error code; a code newer than this client gives the base class with that code."""
    cls = ERROR_CLASSES.get(code or "", MapServerError)
    error = cls(message, retryable=retryable, retry_after_s=retry_after_s)
    if code is not None and cls is MapServerError:
        error.code = code
    return error


def error_from_reply(reply: ErrorReply) -> MapServerError:
    """The exception for a `reply_err` of the server."""
    error = error_from_code(
        ErrorCode(reply.code).value,
        reply.message,
        retryable=reply.retryable,
        retry_after_s=reply.retry_after_s,
    )
    if reply.reason is not ABSENT:
        error.reason = reply.reason
    return error
