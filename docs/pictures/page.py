"""Draw docs/pictures/page.png and page.gif: the page of `potserver serve --web`, during a drive through a made-up street.

python docs/pictures/page.py [FOLDER]      two minutes; needs chromium
"""

from __future__ import annotations

import io
import json
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

from potclient import MapClient
from potclient.datasets import RecordedScan, open_dataset
from potserver.config import load_settings
from potserver.server import MapServer
from tests.integration.browser import Browser, find_browser

DATASET, EVERY = "town:terraces:60m:5", 5
WINDOW, GIF_WIDTH, COLOURS = (1000, 700), 700, 128
MS_A_FRAME, MS_LAST = 450, 3000
DEADLINE_S = 120.0
PLACES = [
    (x / 20, y / 20) for y in (9, 10, 8) for x in (9, 10, 11, 8, 12)
]  # of the map's part of the window, to click


def wait_for(found: Callable[[], Any]) -> Any:
    """What is found, once it is."""
    end = time.monotonic() + DEADLINE_S
    while not (value := found()):
        if time.monotonic() > end:
            raise TimeoutError("the page does not show it")
        time.sleep(0.1)
    return value


class Page:
    """The page of a server, and pictures of it."""

    def __init__(self, browser: Browser, client: MapClient) -> None:
        self.browser, self._client = browser, client

    def follow(self) -> None:
        """Wait until it shows the map as it is now."""
        revision = str(self._client.info().map_revision)
        wait_for(lambda: self.browser.evaluate("document.body?.dataset.revision") == revision)

    def shot(self) -> Image.Image:
        with Image.open(io.BytesIO(self.browser.picture())) as picture:
            return picture.convert("RGB")

    def drive(self, scans: list[RecordedScan]) -> list[Image.Image]:
        """A picture after each scan."""
        pictures = []
        for scan in scans:
            self._client.publish(scan.points, scan.T_map_sensor, is_return=scan.is_return, wait=True)
            self._client.flush()
            self.follow()
            pictures.append(self.shot())
        return pictures

    def ask(self) -> Image.Image:
        """The slice, and what a click on it is told."""
        self.browser.evaluate("document.getElementById('cut').click()")
        wait_for(lambda: self.browser.evaluate("document.body.dataset.slice"))
        width, height = (
            self.browser.evaluate(f"document.querySelector('canvas').{side}") for side in ("width", "height")
        )
        answer = None
        for x, y in PLACES:
            self.browser.click(round(x * width), round(y * height))
            answer = wait_for(
                lambda before=answer: (
                    (a := self.browser.evaluate("document.body.dataset.answer")) != before and a
                )
            )
            if json.loads(answer)["observed"]:
                return self.shot()
        raise RuntimeError("no place that was clicked is observed")


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    program = find_browser()
    if program is None:
        raise SystemExit("no chromium here")
    scans = list(open_dataset(DATASET, max_range_m=25.0)[::EVERY])
    settings = load_settings(overrides={"web.listen": "127.0.0.1:0"})
    with (
        tempfile.TemporaryDirectory() as profile,
        MapServer(settings, listen="tcp/127.0.0.1:0") as server,
        MapClient(server.endpoint) as client,
        Browser(program, Path(profile), *WINDOW, DEADLINE_S) as browser,
    ):
        client.wait_ready()
        assert server.web is not None
        address = f"http://{server.web.address}"
        urllib.request.urlopen(f"{address}/api/state").close()  # the page watches from here on
        page = Page(browser, client)
        for scan in scans:  # once unseen, so that the page looks at the whole street
            client.publish(scan.points, scan.T_map_sensor, is_return=scan.is_return, wait=True)
        client.flush()
        browser.open(address)
        page.follow()
        client.control("clear")
        page.follow()
        pictures = page.drive(scans)
        pictures.append(page.ask())
    pictures[-1].quantize(COLOURS, method=Image.Quantize.MEDIANCUT).save(folder / "page.png", optimize=True)
    height = round(pictures[0].height * GIF_WIDTH / pictures[0].width)
    small = [picture.resize((GIF_WIDTH, height), Image.Resampling.LANCZOS) for picture in pictures]
    both = Image.new("RGB", (GIF_WIDTH, 2 * height))  # the colours of surfaces, and those of the slice
    for row, picture in enumerate((small[-2], small[-1])):
        both.paste(picture, (0, row * height))
    palette = both.quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in small]
    durations = [MS_A_FRAME] * (len(frames) - 2) + [MS_LAST // 2, MS_LAST]
    frames[0].save(
        folder / "page.gif",
        save_all=True,
        append_images=frames[1:],
        loop=0,
        optimize=True,
        duration=durations,
    )
    for name in ("page.png", "page.gif"):
        print(f"{folder / name}: {(folder / name).stat().st_size / 1e3:,.0f} kB")


if __name__ == "__main__":
    main()
