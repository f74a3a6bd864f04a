"""`potserver ros`: the bridge between ROS 2 and a map that is served elsewhere, until a signal comes."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from typing import Any

from potserver.commands.shared import EXIT_OK, EXIT_UNCLEAN, add_verb, settings_of

_ABOUT = """\
Map the clouds of ROS 2 topics, and publish the map as ROS 2 topics, with a server that runs elsewhere. No ROS is
needed here: topics are taken from Zenoh, as rmw_zenoh and zenoh-bridge-ros2dds put them. `potserver serve --ros` does
the same inside the server.

Each namespace is a robot: `/robot1/points` goes into the map as robot `robot1`. A cloud's pose is the one at its own
stamp, from /tf and /tf_static, or from --set ros.poses=/odom. A cloud without one is dropped and counted, and the log
names the frames that were missing. docs/ros.md has the rest; `potserver config show` lists all settings of the table `ros`."""

_EXAMPLES = """\
examples:
  potserver ros /points                                  ROS router and server are one Zenoh network, entered at 127.0.0.1:7447
  potserver ros /points /scan --server tcp/base:7447     the server is on another network
  potserver ros /points --set ros.poses=/odom --set ros.map_frame=odom
  potserver ros                                          nothing in, only the map's topics out"""


def add(commands: Any) -> None:
    """Add the verb."""
    from potclient.session import add_zenoh_arguments

    parser = add_verb(
        commands,
        "ros",
        _run,
        help="bridge ROS 2 and a map until a signal comes",
        description=_ABOUT,
        epilog=_EXAMPLES,
    )
    parser.add_argument("ros", nargs="*", metavar="TOPIC", help="of PointCloud2 or LaserScan")
    parser.add_argument("--server", metavar="ENDPOINT", help="of the map's server [the same network as ROS]")
    parser.add_argument("--map", default="default", metavar="ID", help="[default]")
    parser.add_argument("--root", metavar="KEY", help="first chunks of all keys of the map [pot/v1]")
    parser.add_argument("--settings", metavar="FILE", help="TOML settings file (also POTSERVER_SETTINGS)")
    parser.add_argument(
        "--set", action="append", dest="sets", default=[], metavar="KEY=VALUE", help="any setting, e.g. ros.grid_m=0.05"
    )  # fmt: skip
    parser.add_argument("--log-level", choices=("debug", "info", "warning", "error"), help="[info]")
    parser.add_argument("--log-format", choices=("auto", "json", "console"), help="[auto]")
    add_zenoh_arguments(parser)


def _run(options: argparse.Namespace) -> int:
    import zenoh

    from potclient.client import MapClient
    from potclient.session import SessionOptions, open_session, options_from_arguments
    from potserver.commands.serve import StopSignals
    from potserver.health import Health
    from potserver.log import configure_logging, get_logger
    from potserver.ros.bridge import Bridge

    named = ("ros", "root", "settings", "sets", "log_level", "log_format")
    settings = settings_of(argparse.Namespace(**{name: getattr(options, name) for name in named}))
    configure_logging(settings.log.level, settings.log.format)
    zenoh.try_init_log_from_env()  # RUST_LOG
    log, health = get_logger("potserver.cli"), Health()
    with StopSignals.installed() as stop, contextlib.ExitStack() as stack:
        network = options_from_arguments(options)
        # latched topics count by time
        network = dataclasses.replace(
            network, overrides=(*network.overrides, ("timestamping/enabled", "true"))
        )
        session = stack.enter_context(open_session(network))
        client = MapClient(
            map=options.map,
            root=settings.root,
            options=SessionOptions(connect=(options.server,), connect_timeout_s=options.wait)
            if options.server
            else None,
            session=None if options.server else session,
        )
        stack.callback(client.close)
        bridge = Bridge(session, client, settings.ros, health)
        stop.wait()
        log.info("stop_requested", signal=stop.name)
        ended = bridge.close()
        log.info("ros_bridge_stopped", clean=ended, counters=health.counters())
    return EXIT_OK if ended else EXIT_UNCLEAN
