"""All addresses: /live, /ready and /metrics for operators, and the page with the map."""

from __future__ import annotations

from collections.abc import Callable

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from potschemas import messages
from potserver.web.metrics import CONTENT_TYPE, exposition
from potserver.web.pages import Pages


def make_app(state: Callable[[], str], pages: Pages, stats: Callable[[], messages.Stats]) -> Starlette:
    """The application.

    Args:
        state: "serving", or what the server does instead.
        pages: With the map.
        stats: The counters now.
    """
    metrics = exposition(stats)

    def live(request: Request) -> Response:
        """200 as long as the process answers at all."""
        return PlainTextResponse("live\n")

    def ready(request: Request) -> Response:
        """200 while clouds and questions are taken, 503 during the start and the drain."""
        now = state()
        return PlainTextResponse(f"{now}\n", status_code=200 if now == "serving" else 503)

    def scrape(request: Request) -> Response:
        return Response(metrics(), media_type=CONTENT_TYPE)

    # plain functions: starlette runs them on threads, so that a slow scrape holds up nobody
    operators = [Route("/live", live), Route("/ready", ready), Route("/metrics", scrape)]
    return Starlette(routes=[*operators, *pages.routes()])
