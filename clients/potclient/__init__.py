"""The robot side of potserver: numpy, Zenoh and the schemas; no torch.

from potclient import MapClient
with MapClient("tcp/127.0.0.1:7447", map="default") as client:
    receipt = client.integrate(points, T_map_sensor, robot="r1")
    occ = client.occupancy(queries)  # .mean .var .latent_mean .latent_var .observed .revision
    receipt.kernels.occupancy(queries)  # the same formulas offline, on the kernels that came back
"""

from potclient.client import MapClient, Subscription
from potclient.errors import (
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
    MapServerError,
    NoPoseError,
    NoServerError,
    OldStampError,
    OutOfRangeError,
    OverloadedError,
    PotclientError,
    QueryTimeoutError,
    ShapeError,
    ShuttingDownError,
    TooLargeError,
    UnknownAtomError,
    UnknownRobotError,
    UnsupportedError,
    UsageError,
)
from potclient.kernels import KernelSet
from potclient.results import Atom, FeedCounts, Grid, Occupancy, Receipt, TransportedParams
from potclient.session import SessionOptions
from potschemas import __version__

__all__ = [
    "Atom",
    "BadMessageError",
    "BadPointsError",
    "BadPoseError",
    "BadReplyError",
    "ClosedError",
    "DatasetError",
    "DeadlineError",
    "EmptyError",
    "FeedCounts",
    "Grid",
    "IncompleteReplyError",
    "InternalError",
    "KernelSet",
    "LostReplyError",
    "MapClient",
    "MapServerError",
    "NoPoseError",
    "NoServerError",
    "Occupancy",
    "OldStampError",
    "OutOfRangeError",
    "OverloadedError",
    "PotclientError",
    "QueryTimeoutError",
    "Receipt",
    "SessionOptions",
    "ShapeError",
    "ShuttingDownError",
    "Subscription",
    "TooLargeError",
    "TransportedParams",
    "UnknownAtomError",
    "UnknownRobotError",
    "UnsupportedError",
    "UsageError",
    "__version__",
]
