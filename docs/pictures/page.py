"""Draw docs/pictures/page.png: the page of `potserver serve --web`, after a drive through a made-up street.

python docs/pictures/page.py [OUT]      a minute; needs chromium
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path

from PIL import Image

from potclient import MapClient
from potclient.datasets import open_dataset
from potserver.config import load_settings
from potserver.server import MapServer

DATASET, EVERY = "town:terraces:60m:5", 10
SENSOR_M = 1.6  # above the point that is asked
SIZE, COLOURS = (1100, 700), 128
CHROMIUM = (
    "chromium", "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars",
    f"--window-size={SIZE[0]},{SIZE[1]}", "--virtual-time-budget=8000",
)  # fmt: skip


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("page.png")
    settings = load_settings(overrides={"web.listen": "127.0.0.1:0"})
    with (
        tempfile.TemporaryDirectory() as folder,
        MapServer(settings, listen="tcp/127.0.0.1:0") as server,
        MapClient(server.endpoint) as client,
    ):
        client.wait_ready()
        assert server.web is not None
        page = f"http://{server.web.address}"
        urllib.request.urlopen(f"{page}/api/state").close()  # the page watches from here on
        for scan in open_dataset(DATASET, max_range_m=25.0)[::EVERY]:
            client.publish(scan.points, scan.T_map_sensor, is_return=scan.is_return, wait=True)
        client.flush()
        shot, (x, y, z) = Path(folder) / "shot.png", scan.T_map_sensor[:3, 3]
        asked = f"{page}/?ask={x:.2f},{y:.2f},{z - SENSOR_M:.2f}"
        subprocess.run([*CHROMIUM, f"--screenshot={shot}", asked], check=True, capture_output=True)
        with Image.open(shot) as screen:
            small = screen.convert("RGB").quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
        small.save(out, optimize=True)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
