"""Draw docs/pictures/above_ground.png: the bundled rooms as Nav2's map_server sees them, by two choices of heights.

python docs/pictures/above_ground.py [OUT]      a minute, most of it the server's start
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from potclient import MapClient
from potclient.cli import main as potclient
from potserver.bundled import open_bundled
from potserver.config import Settings
from potserver.server import MapServer

CHOICES = ("--band 0.1 1.5", "--above-ground 0.15 1.5")


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("above_ground.png")
    figure, axes = plt.subplots(1, 2, figsize=(7.2, 4.2), dpi=100, layout="constrained")
    with tempfile.TemporaryDirectory() as folder, MapServer(Settings(), listen="tcp/127.0.0.1:0") as server:
        picture = Path(folder) / "map.pgm"
        with MapClient(server.endpoint, timeout_s=60.0) as client:
            client.wait_ready(300.0)
            for scan in open_bundled("rooms"):
                client.integrate(scan.points, scan.T_map_sensor, is_return=scan.is_return)
        for axis, choice in zip(axes, CHOICES, strict=True):
            words = ["export", "pgm", "--resolution", "0.05", *choice.split(), "-o", str(picture)]
            assert potclient([*words, "-e", server.endpoint]) == 0
            axis.imshow(plt.imread(picture), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            axis.set_title(choice, fontsize=10, loc="left")
            axis.set_xticks([])
            axis.set_yticks([])
    figure.savefig(out)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
