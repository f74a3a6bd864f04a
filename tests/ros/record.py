"""Record what a stranger's ROS 2 node puts on Zenoh: `python -m tests.ros.record` writes tests/ros/vectors/*.json anew.

The node is the package zenoh-ros2-sdk; what is recorded is key, attachment and payload, byte by byte.
"""

from __future__ import annotations

import base64
import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from tests.integration.conftest import until
from tests.integration.ros_strangers import Stranger
from tests.integration.scripted import free_port
from tests.ros import messages as ros

VECTORS = Path(__file__).with_name("vectors")
STAMP_NS = 1_700_000_000_250_000_000
# organised, with a point that is no number, a ring between the coordinates, and padding
ROWS = np.zeros(
    6,
    {
        "names": ["x", "y", "ring", "z", "t"],
        "formats": ["<f4", "<f4", "<u2", "<f4", "<u4"],
        "offsets": [0, 4, 8, 12, 16],
        "itemsize": 24,
    },
)
ROWS["x"], ROWS["y"], ROWS["z"] = [1, 2, 3, np.nan, 5, 6], [0.5] * 6, [-1, 0, 1, 2, 3, 4]
ROWS["ring"], ROWS["t"] = range(6), range(0, 60, 10)


def said() -> dict[str, tuple[str, Any]]:
    """What the node says: file name to topic and message."""
    return {
        "point_cloud": ("/r1/points", ros.cloud(ROWS, "lidar", STAMP_NS, height=2, row_padding=8)),
        "laser_scan": ("/r1/scan", ros.laser([1.0, np.inf, np.nan, 3.0], frame="lidar", stamp_ns=STAMP_NS)),
        "tf": ("/tf", ros.tf(ros.transform("map", "base", STAMP_NS, (1, 2, 0), yaw=0.5))),
        "tf_static": ("/tf_static", ros.tf(ros.transform("base", "lidar", 0, (0, 0, 1.5)))),
    }


def load(name: str) -> tuple[str, bytes, bytes]:
    """Key, attachment and payload of a recorded sample."""
    tree = json.loads((VECTORS / f"{name}.json").read_text())
    return tree["key"], bytes.fromhex(tree["attachment"]), base64.b64decode(tree["payload"])


def main() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    VECTORS.mkdir(exist_ok=True)
    with zenoh.open(config) as session, contextlib.closing(Stranger(endpoint)) as node:
        subscriber = session.declare_subscriber("0/**", zenoh.handlers.FifoChannel(16))
        for name, (topic, message) in said().items():
            node.publish(topic, message)
            sample = until(subscriber.try_recv, name)
            assert sample.attachment is not None
            tree = {
                "key": str(sample.key_expr),
                "attachment": sample.attachment.to_bytes().hex(),
                "payload": base64.b64encode(sample.payload.to_bytes()).decode(),
            }
            (VECTORS / f"{name}.json").write_text(json.dumps(tree, indent=1) + "\n")


if __name__ == "__main__":
    main()
