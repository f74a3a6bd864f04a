"""What the page in the browser asks: the map's tiles, slices, points and rays, of `MapFeed`."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from importlib import resources

import msgspec
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from potclient.errors import PotclientError
from potserver.web.feed import MapFeed
from potserver.web.listener import Served

_BINARY = "application/octet-stream"
_FILES = {
    "index.html": "text/html; charset=utf-8",
    "three.module.min.js": "text/javascript",
    "OrbitControls.js": "text/javascript",
}


class Pages:
    """The page and what it asks; a map is followed from the first request about it on."""

    def __init__(self, served: Served) -> None:
        self._served = served
        self._lock = threading.Lock()
        self._feeds: dict[str, MapFeed] = {}

    def routes(self) -> list[Route]:
        """For the application."""
        asked = {
            "state": self._state,
            "tile": self._tile,
            "slice": self._slice,
            "point": self._point,
            "ray": self._ray,
            "risk": self._risk,
        }
        return [
            Route("/", lambda request: _file("index.html")),
            *(
                Route(f"/{name}", lambda request, name=name: _file(name))
                for name in _FILES
                if name != "index.html"
            ),
            *(Route(f"/api/{name}", _answered(answer)) for name, answer in asked.items()),
        ]

    def close(self) -> None:
        """Follow no map any more."""
        with self._lock:
            feeds, self._feeds = list(self._feeds.values()), {}
        for feed in feeds:
            feed.close()

    def _feed(self, request: Request) -> MapFeed:
        map_id = request.query_params.get("map", self._served.maps[0])
        if map_id not in self._served.maps:
            raise ValueError(f"no map {map_id!r} here; there are {', '.join(self._served.maps)}")
        endpoint = self._served.endpoint()
        if endpoint is None:
            raise PotclientError("the server takes no questions now")
        with self._lock:
            if map_id not in self._feeds:
                self._feeds[map_id] = MapFeed(endpoint, map_id, self._served.root)
            return self._feeds[map_id]

    def _state(self, request: Request) -> Response:
        stats = msgspec.to_builtins(self._served.stats())
        state = self._feed(request).state() | {"maps": self._served.maps, "stats": stats}
        return Response(msgspec.json.encode(state), media_type="application/json")  # NaN becomes null

    def _tile(self, request: Request) -> Response:
        x, y, z = (int(request.query_params[name]) for name in "xyz")
        return Response(self._feed(request).tile((x, y, z)), media_type=_BINARY)

    def _slice(self, request: Request) -> Response:
        return Response(self._feed(request).slice(_numbers(request, "z")[0]), media_type=_BINARY)

    def _point(self, request: Request) -> Response:
        return JSONResponse(self._feed(request).point(_numbers(request, "x", "y", "z")))

    def _ray(self, request: Request) -> Response:
        ends = _numbers(request, "x", "y", "z", "tx", "ty", "tz")
        return JSONResponse(self._feed(request).ray(ends[:3], ends[3:]))

    def _risk(self, request: Request) -> Response:
        ends = _numbers(request, "x", "y", "z", "tx", "ty", "tz")
        (radius_m,) = _numbers(request, "radius")
        if not 0.05 <= radius_m <= 5.0:
            raise ValueError("radius must be 0.05 to 5 m")
        return JSONResponse(self._feed(request).risk(ends[:3], ends[3:], radius_m))


def _answered(answer: Callable[[Request], Response]) -> Callable[[Request], Response]:
    """The answer, or what was wrong: 400 with the question, 503 with the server."""

    def handle(request: Request) -> Response:
        try:
            return answer(request)
        except (ValueError, KeyError) as error:
            return PlainTextResponse(f"{error}\n", status_code=400)
        except PotclientError as error:
            return PlainTextResponse(f"{error}\n", status_code=503)

    return handle


def _numbers(request: Request, *names: str) -> list[float]:
    values = [float(request.query_params[name]) for name in names]
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"{', '.join(names)} must be finite numbers")
    return values


def _file(name: str) -> Response:
    data = resources.files("potserver.web").joinpath("page").joinpath(name).read_bytes()
    return Response(data, media_type=_FILES[name], headers={"Cache-Control": "no-cache"})
