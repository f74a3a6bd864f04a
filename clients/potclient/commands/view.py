"""`potclient view`: the map in 3D, live, in Rerun."""

from __future__ import annotations

import argparse
import contextlib
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from potclient.commands.output_files import output_file
from potclient.commands.shared import EXIT_OK, add_command, client_of, note, positive, say
from potclient.errors import UsageError

if TYPE_CHECKING:
    from potclient.view.bag import BagPicture
    from potclient.view.picture import MapPicture

_RESOLUTION_M = 0.25
_WEB_PORT, _STREAM_PORT = 9090, 9876


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "view",
        run,
        help="the map in 3D, live, in Rerun",
        description="""Show the map in 3D and follow it: robots' scans and ways, the surface coloured by its standard deviation,
free space and the edge of the unknown (switch them on in the list of entities), the map's own scores and the server's latencies
over time.

Clouds are seen as robots publish them; those that are sent with `integrate` are seen by what they change. Without a flag
Rerun's viewer opens on this machine. It ends with ctrl-c, or after --seconds.""",
        epilog="""examples:
  potclient view                                  Rerun's viewer on this machine
  potclient view --web 9090                       for a browser on this machine
  potclient view --save drive.rrd --seconds 60    a recording; `rerun drive.rrd` opens it
  potclient view --save drive.mcap                scans, poses and surfaces as ROS 2 messages, for Foxglove
  potclient export rrd -o map.rrd --resolution 0.2   the map as it is, without following it""",
        timeout_s=60.0,
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--save",
        type=output_file,
        metavar="FILE",
        help="write a recording instead: .rrd, or .mcap with ROS 2 messages",
    )
    where.add_argument(
        "--web",
        type=int,
        nargs="?",
        const=_WEB_PORT,
        metavar="PORT",
        help=f"serve the viewer for browsers instead (default port {_WEB_PORT})",
    )
    parser.add_argument(
        "--stream-port",
        type=int,
        default=_STREAM_PORT,
        metavar="PORT",
        help=f"--web: what the browser reads from (default {_STREAM_PORT})",
    )
    parser.add_argument(
        "--resolution",
        type=positive,
        default=_RESOLUTION_M,
        metavar="METRES",
        help=f"edge of the cells that are asked for (default {_RESOLUTION_M:g})",
    )
    parser.add_argument("--seconds", type=positive, metavar="S", help="stop after S seconds (default: never)")


def run(arguments: argparse.Namespace) -> int:
    from potclient.view.live import LiveView

    if arguments.save is not None and arguments.save.suffix not in (".rrd", ".mcap"):
        raise UsageError(f"{arguments.save}: a recording ends in .rrd (Rerun) or .mcap (ROS 2 messages)")
    with client_of(arguments) as client:
        server = client.wait_ready()
        with contextlib.closing(_picture(arguments, f"map {arguments.map} of {server}")) as picture:
            view = LiveView(client, picture, arguments.resolution)
            with _ending(arguments.seconds) as end, contextlib.suppress(KeyboardInterrupt):
                view.run(end)
        say(f"{view.n_tiles} tiles and {view.n_clouds} clouds drawn, to revision {view.drawn_revision}")
        if view.n_unplaced:
            note(f"{view.n_unplaced} clouds did not say where they were taken and are not shown")
    return EXIT_OK


def _picture(arguments: argparse.Namespace, name: str) -> BagPicture | MapPicture:
    """What is drawn on, open."""
    if arguments.save is not None and arguments.save.suffix == ".mcap":
        from potclient.view.bag import BagPicture

        note(f"recording to {arguments.save}, which is there at the end")
        return BagPicture(arguments.save)
    from potclient.view.picture import MapPicture

    picture = MapPicture(name)
    if arguments.save is not None:
        picture.save(arguments.save)
        note(f"recording to {arguments.save}")
    elif arguments.web is not None:
        note(f"open {picture.serve(arguments.web, arguments.stream_port)}")
    else:
        picture.show()
    return picture


@contextlib.contextmanager
def _ending(seconds: float | None) -> Iterator[threading.Event]:
    """An event that is set after so many seconds, or never."""
    end = threading.Event()
    timer = None if seconds is None else threading.Timer(seconds, end.set)
    if timer is not None:
        timer.start()
    try:
        yield end
    finally:
        if timer is not None:
            timer.cancel()
