"""`potclient map`: the map as a whole."""

from __future__ import annotations

import argparse
from typing import Any

from potclient.commands.pose_flag import add_pose_flag, pose_of
from potclient.commands.shared import EXIT_OK, add_command, client_of, say
from potclient.errors import UsageError
from potclient.questions.control import CONTROL_TIMEOUT_S
from potschemas.keys import CONTROL_VERBS


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "map",
        run,
        timeout_s=CONTROL_TIMEOUT_S,
        help=f"the map as a whole: {', '.join(CONTROL_VERBS)}",
        description="""Have the server save its map, load or merge a saved one, forget a robot or everything, or finish its
queue and take no more clouds. Each comes after all clouds that the server has taken before it.

What a server keeps survives its restarts by itself. `save NAME` makes a copy beside that, in the folder `saved` of the
server's store: `load NAME` puts it in the place of the present map, `merge NAME` adds what it knows.""",
        epilog="""examples:
  potclient map save                    write everything to the disk now
  potclient map save before-the-rain    and a copy with a name
  potclient map load before-the-rain    go back to it: what came since is gone
  potclient map merge north-wing --pose 12.5 -3.0 0 90
                                        take in what another server saved; its origin in our map: x y z m, yaw degrees
  potclient map forget rover-1          take out what one robot has seen
  potclient map clear                   forget everything
  potclient map drain                   before the server is replaced""",
    )
    parser.add_argument("verb", choices=CONTROL_VERBS, help="what to do")
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help="of a saved map, for save, load and merge; of a robot, for forget",
    )
    add_pose_flag(parser)


def run(arguments: argparse.Namespace) -> int:
    verb, name = arguments.verb, arguments.name
    if verb in ("load", "merge") and name is None:
        raise UsageError(f"map: {verb} which? name a saved map")
    if verb == "forget" and name is None:
        raise UsageError("map: forget whom? name a robot; `map clear` forgets everything")
    if name is not None and verb in ("clear", "drain"):
        raise UsageError(f"map: {verb} takes no name")
    if arguments.pose is not None and verb != "merge":
        raise UsageError(f"map: {verb} takes no pose")
    with client_of(arguments) as client:
        if verb == "forget":
            reply = client.forget(name, timeout_s=arguments.timeout)
        elif verb == "merge":
            pose = None if arguments.pose is None else pose_of(*arguments.pose)
            reply = client.merge(name, pose, timeout_s=arguments.timeout)
        else:
            reply = client.control(verb, name=name, timeout_s=arguments.timeout)
    say(f"{reply.verb}: {reply.message} (revision {reply.map_revision})")
    return EXIT_OK
