"""Draw docs/pictures/view.png: Rerun's viewer after a drive through a made-up street.

    xvfb-run -a -s "-screen 0 1600x900x24" python docs/pictures/view.py [OUT]      two minutes

The viewer needs a screen, real or virtual, and Vulkan (Debian's mesa-vulkan-drivers will do).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from PIL import Image

from potclient import MapClient
from potclient.datasets import open_dataset
from potclient.view.live import LiveView
from potclient.view.picture import MapPicture
from potserver.config import Settings
from potserver.server import MapServer

DATASET, EVERY, RESOLUTION_M = "town:terraces:60m:5", 6, 0.25
SIZE, COLOURS = (1200, 675), 128
VIEWER = ("--renderer", "vulkan", "--window-size", "1600x900")


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("view.png")
    with tempfile.TemporaryDirectory() as folder:
        recording, shot = Path(folder) / "drive.rrd", Path(folder) / "shot.png"
        record(recording)
        program = Path(sys.executable).with_name("rerun")
        subprocess.run([program, *VIEWER, "--screenshot-to", shot, recording], check=True)
        with Image.open(shot) as screen:
            small = screen.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
        small.quantize(COLOURS, method=Image.Quantize.MEDIANCUT).save(out, optimize=True)
    print(f"wrote {out}")


def record(path: Path) -> None:
    """A drive, followed as `potclient view --save` follows it."""
    picture, end = MapPicture("a made-up street"), threading.Event()
    picture.save(path)
    with MapServer(Settings(), listen="tcp/127.0.0.1:0") as server, MapClient(server.endpoint) as client:
        client.wait_ready(300.0)
        view = LiveView(client, picture, RESOLUTION_M)
        thread = threading.Thread(target=view.run, args=(end,))
        thread.start()
        for scan in open_dataset(DATASET, max_range_m=25.0)[::EVERY]:
            client.publish(scan.points, scan.T_map_sensor, is_return=scan.is_return, wait=True)
        client.flush()
        newest = client.info().map_revision
        while view.drawn_revision < newest:
            time.sleep(0.5)
        end.set()
        thread.join()
    picture.close()


if __name__ == "__main__":
    main()
