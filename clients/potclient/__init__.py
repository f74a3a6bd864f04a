"""The robot side of potserver: numpy, Zenoh and the schemas; no torch.

from potclient import MapClient
with MapClient("tcp/127.0.0.1:7447", map="default") as client:
    receipt = client.integrate(points, T_map_sensor, robot="r1")
    occ = client.occupancy(queries)  # .mean .var .latent_mean .latent_var .observed .revision
    receipt.kernels.occupancy(queries)  # the same formulas offline, on the kernels that came back
"""

from potclient.atoms import Atom
from potclient.client import MapClient
from potclient.errors import (
    AccessError,
    AtomRefusedError,
    BadMessageError,
    BadPointsError,
    BadPoseError,
    BadReplyError,
    ClosedError,
    DatasetError,
    DeadlineError,
    EmptyError,
    IncompleteReplyError,
    InternalError,
    LostReplyError,
    MapDamagedError,
    MapFileError,
    MapFullError,
    MapServerError,
    NoPoseError,
    NoServerError,
    OldSequenceError,
    OldStampError,
    OutOfRangeError,
    OverloadedError,
    PotclientError,
    QueryTimeoutError,
    ReadOnlyError,
    ShapeError,
    ShuttingDownError,
    StorageError,
    TooLargeError,
    TooManyError,
    UnknownAtomError,
    UnknownMapError,
    UnknownRobotError,
    UnsupportedError,
    UsageError,
)
from potclient.feed import FeedOptions
from potclient.kernels import KernelSet
from potclient.link import Subscription
from potclient.mirror import MapMirror, MirrorUpdate
from potclient.occupancy import Grid, Occupancy
from potclient.questions.rays import Rays
from potclient.questions.risk import Risk
from potclient.results import FeedCounts, Receipt, TransportedParams
from potclient.session import SessionOptions
from potschemas import __version__

__all__ = [
    "AccessError",
    "Atom",
    "AtomRefusedError",
    "BadMessageError",
    "BadPointsError",
    "BadPoseError",
    "BadReplyError",
    "ClosedError",
    "DatasetError",
    "DeadlineError",
    "EmptyError",
    "FeedCounts",
    "FeedOptions",
    "Grid",
    "IncompleteReplyError",
    "InternalError",
    "KernelSet",
    "LostReplyError",
    "MapClient",
    "MapDamagedError",
    "MapFileError",
    "MapFullError",
    "MapMirror",
    "MapServerError",
    "MirrorUpdate",
    "NoPoseError",
    "NoServerError",
    "Occupancy",
    "OldSequenceError",
    "OldStampError",
    "OutOfRangeError",
    "OverloadedError",
    "PotclientError",
    "QueryTimeoutError",
    "Rays",
    "ReadOnlyError",
    "Receipt",
    "Risk",
    "SessionOptions",
    "ShapeError",
    "ShuttingDownError",
    "StorageError",
    "Subscription",
    "TooLargeError",
    "TooManyError",
    "TransportedParams",
    "UnknownAtomError",
    "UnknownMapError",
    "UnknownRobotError",
    "UnsupportedError",
    "UsageError",
    "__version__",
]
