"""`potclient map`: the map as a whole."""

from __future__ import annotations

import argparse
from typing import Any

from potclient.client import MapClient
from potclient.commands.pose_flag import add_pose_flag, pose_of
from potclient.commands.shared import EXIT_OK, add_command, add_verb, client_of, say
from potclient.questions.control import CONTROL_TIMEOUT_S
from potschemas import messages
from potschemas.keys import CONTROL_VERBS

_SAVED = "of a saved map"
# verb: what it does, its examples, its name's help and whether it needs one
_VERBS: dict[str, tuple[str, str, str | None, bool]] = {
    "save": (
        """Write the map to the disk now. With a name, write also a copy, in the folder `saved` of the server's store,
from which `load` and `merge` take it.""",
        """  potclient map save                    write everything to the disk now
  potclient map save before-the-rain    and a copy with a name""",
        "of the copy",
        False,
    ),
    "load": (
        "Put a saved map in the place of the present one, which is gone then.",
        "  potclient map load before-the-rain    go back to it: what came since is gone",
        _SAVED,
        True,
    ),
    "clear": ("Forget everything.", "  potclient map clear", None, False),
    "drain": (
        "Finish the queue and take no more clouds: before the server is replaced.",
        "  potclient map drain",
        None,
        False,
    ),
    "merge": (
        "Add what a saved map knows, as if one server had been fed by both. Scans that both hold would count twice.",
        """  potclient map merge north-wing --pose 12.5 -3.0 0 90
                                        take in what another server saved; its origin in our map: x y z m, yaw degrees""",
        _SAVED,
        True,
    ),
    "forget": (
        "Take out what one robot has seen; `potclient map clear` forgets everything.",
        "  potclient map forget rover-1",
        "of a robot",
        True,
    ),
}


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "map",
        run,
        timeout_s=CONTROL_TIMEOUT_S,
        help=f"the map as a whole: {', '.join(CONTROL_VERBS)}",
        description="""Have the server save its map, load or merge a saved one, forget a robot or everything, or finish its
queue and take no more clouds. Each comes after all clouds that the server has taken before it. What a server keeps survives
its restarts by itself. `potclient map VERB --help` explains each verb.""",
        epilog="examples:\n" + "\n".join(examples for _, examples, _, _ in _VERBS.values()),
    )
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", dest="verb", required=True)
    for name in CONTROL_VERBS:
        about, examples, named, is_needed = _VERBS[name]
        verb = add_verb(
            verbs,
            name,
            run,
            timeout_s=CONTROL_TIMEOUT_S,
            help=about.splitlines()[0].split(". ")[0].rstrip("."),
            description=about,
            epilog=f"examples:\n{examples}",
        )
        if named is not None:
            verb.add_argument(
                "name", nargs=None if is_needed else "?", default=None, metavar="NAME", help=named
            )
        if name == "merge":
            add_pose_flag(verb)


def run(arguments: argparse.Namespace) -> int:
    with client_of(arguments) as client:
        reply = _reply(client, arguments)
    say(f"{reply.verb}: {reply.message} (revision {reply.map_revision})")
    return EXIT_OK


def _reply(client: MapClient, arguments: argparse.Namespace) -> messages.ControlReply:
    verb, timeout_s = arguments.verb, arguments.timeout
    if verb == "forget":
        return client.forget(arguments.name, timeout_s=timeout_s)
    if verb == "merge":
        pose = None if arguments.pose is None else pose_of(*arguments.pose)
        return client.merge(arguments.name, pose, timeout_s=timeout_s)
    return client.control(verb, name=getattr(arguments, "name", None), timeout_s=timeout_s)
