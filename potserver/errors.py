"""Everything the server raises on purpose: one class per thing a caller can act on. Imports nothing."""

from __future__ import annotations


class PotserverError(Exception):
    """Base of all expected errors. `code` is contract (potschemas.ErrorCode); the text is for people."""

    code: str = "internal"
    retryable: bool = False

    def __init__(
        self,
        message: str,
        *,
        retry_after_s: float | None = None,
        reason: str | None = None,
        next_seq: int | None = None,
    ) -> None:
        super().__init__(message)
        self.next_seq = next_seq  # of a cloud that would have been taken
        self.retry_after_s = retry_after_s
        self.reason = reason  # finer than the code, where one code has several


class BadMessageError(PotserverError):
    """The bytes are not the message that the key promises."""

    code = "bad_message"


class ShapeError(PotserverError):
    """An array has the wrong shape, dtype or byte count."""

    code = "bad_array"


class BadPoseError(PotserverError):
    """A pose is not a rigid transform, or not finite."""

    code = "bad_pose"


class BadPointsError(PotserverError):
    """Coordinates are NaN or infinite."""

    code = "bad_points"


class EmptyError(PotserverError):
    """Nothing to do: no points at all, or none inside the range limits."""

    code = "empty"


class TooLargeError(PotserverError):
    """Bytes, points or cells beyond the limit."""

    code = "too_large"


class OutOfRangeError(PotserverError):
    """Coordinates beyond what the map may hold."""

    code = "out_of_range"


class OldStampError(PotserverError):
    """The stamp is too far in the future."""

    code = "old_stamp"


class OldSequenceError(PotserverError):
    """The cloud's number is not above the last accepted one of its session; `next_seq` would be taken."""

    code = "old_seq"


class MapFullError(PotserverError):
    """The map takes no more: its limit of bytes is reached, or that of robots."""

    code = "map_full"


class MapDamagedError(PotserverError):
    """The disk cannot read back a part of the map that lay on it; a restart reads what was acknowledged."""

    code = "map_damaged"
    retryable = True


class NoPoseError(PotserverError):
    """The cloud has no pose, and the pose stream has none at its stamp."""

    code = "no_pose"


class UnknownRobotError(PotserverError):
    """The robot's id is not legal, or not on the allow list."""

    code = "unknown_robot"


class UnknownAtomError(PotserverError):
    """No atom of this id in the dictionary."""

    code = "unknown_atom"


class AtomRefusedError(PotserverError):
    """The atom may not join the dictionary; `reason` says which rule it breaks."""

    code = "atom_refused"


class ReadOnlyError(PotserverError):
    """The server takes no changes of its dictionary, or was started to change nothing at all."""

    code = "read_only"


class UnsupportedError(PotserverError):
    """No such operation or verb."""

    code = "unsupported"


class OverloadedError(PotserverError):
    """The queue is full; try again after `retry_after_s`."""

    code = "overloaded"
    retryable = True


class TooManyError(PotserverError):
    """This client asks faster than one may; try again after `retry_after_s`."""

    code = "too_many"
    retryable = True


class DeadlineError(PotserverError):
    """The asker's deadline passed before the work was done."""

    code = "deadline"
    retryable = True


class ShuttingDownError(PotserverError):
    """The server takes no more work."""

    code = "shutting_down"
    retryable = True


class StorageError(PotserverError):
    """The disk did not take what had to be kept: it is full, or broken. Nothing was changed."""

    code = "storage"
    retryable = True


class UnknownMapError(PotserverError):
    """No map was saved under this name."""

    code = "unknown_map"


class MapFileError(PotserverError):
    """A kept map is damaged, of another format, or does not fit the settings; `reason` says which."""

    code = "map_file"


class DictionaryError(PotserverError):
    """An atom dictionary file is missing, damaged, or of another version."""

    code = "internal"


class SolverError(PotserverError):
    """A numerical solve ended without a usable result."""

    code = "internal"


class SettingsError(PotserverError):
    """A setting is unknown or has an illegal value."""

    code = "internal"


def error_classes() -> dict[str, type[PotserverError]]:
    """Every class by its code; the classes that never leave the process share `internal` with the base."""
    return {cls.code: cls for cls in PotserverError.__subclasses__() if cls.code != "internal"} | {
        "internal": PotserverError
    }
