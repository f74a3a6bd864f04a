"""A robot that drives: every scan goes into the map, and its receipt tells what became of it.

    potserver serve
    python clients/examples/robot.py [--connect tcp/127.0.0.1:7447] [DATASET]

DATASET is anything that `potclient publish --help` names.
"""

from __future__ import annotations

import argparse

from potclient import FeedOptions, MapClient, Receipt
from potclient.datasets import open_dataset


def report(receipt: Receipt) -> None:
    """Called on a thread of the client's, with every receipt of a published scan."""
    message = receipt.message
    print(f"scan {receipt.seq}: {receipt.status.value}, {message.map_kernels} kernels in the map")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("dataset", nargs="?", default="generated:2d")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--limit", type=int, default=10, metavar="N", help="scans to send (default 10)")
    arguments = parser.parse_args()

    recording = open_dataset(arguments.dataset)[: arguments.limit]
    with MapClient(arguments.connect, feed=FeedOptions(on_receipt=report)) as client:
        client.wait_ready()

        # Acknowledged: wait until the scan is in the map. The receipt brings its kernels.
        first = recording[0]
        receipt = client.integrate(
            first.to_send, first.T_map_sensor, is_return=first.is_return, robot="rover"
        )
        assert receipt.kernels is not None
        print(f"the first scan: {len(first)} beams became {len(receipt.kernels)} kernels")

        # Published: go on at once. At most two scans are without a receipt; `wait=True` drops none of a recording.
        for scan in recording[1:]:
            client.publish(
                scan.to_send, scan.T_map_sensor, is_return=scan.is_return, robot="rover", wait=True
            )
        client.flush()
        counts = client.counts()
        print(f"{counts.accepted} of {counts.offered} published scans accepted, {counts.unknown} unknown")


if __name__ == "__main__":
    main()
