"""`potserver acl`: configurations that let each robot, planner and operator do its own work and no more."""

from __future__ import annotations

import argparse
import json
import os
import secrets
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from potschemas.keys import DEFAULT_ROOT
from potserver.adapters.access import CONFIG, SERVER, USERS, Auth, Roles, client_config, server_config
from potserver.commands.shared import EXIT_OK, add_verb, say
from potserver.errors import SettingsError
from potserver.limits import Limits

EXIT_OPEN = 1  # somebody can do what it may not, or cannot do what it may
_ROLES, _CERTIFICATES = "roles.json", "certificates.sh"

_ABOUT = """\
Write Zenoh configurations for a server and for everybody who reaches it: robots send as themselves and hear their own
receipts, planners ask, operators change maps and the dictionary, and nobody else gets in. Or, with --check, log in as each of
them on loopback, try everything, and show what is allowed and denied: Zenoh drops without a word what is denied."""

_EXAMPLES = """\
examples:
  potserver acl --robots r1,r2 --planners p1 --operators ops --host maps.example -o conf/
  sh conf/certificates.sh                     certificates for all of them; once, then keep ca.key away from robots
  potserver acl --check -o conf/              what each can do, measured
  potserver serve -c conf/server.json5        and on the robot:  potclient publish scans/ --robot r1 -c r1.json5
  potserver acl --auth password ...           users and passwords in clear text, for networks that are trusted

Copy to each machine its own NAME.json5, and with certificates NAME.pem, NAME.key and ca.pem; --at says where they will lie.
Written anew, passwords stay as they were."""

_SCRIPT = """\
#!/bin/sh
# Makes, once, an authority of this site (ca.key, ca.pem), and a key and a certificate for each identity, beside this script.
# The server's holds the names under which it is reached: {hosts}. Written by `potserver acl`.
set -eu
umask 077
cd "$(dirname "$0")"
[ -f ca.key ] || openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 3650 \\
  -keyout ca.key -out ca.pem -subj "/CN=potserver site authority" -addext "keyUsage=critical,keyCertSign"
for name in {names}; do
  [ ! -f "$name.pem" ] || continue
  printf 'basicConstraints=CA:FALSE\nextendedKeyUsage=%s\nsubjectAltName=%s\n' \\
    "$([ "$name" = {server} ] && echo serverAuth || echo clientAuth)" \\
    "$([ "$name" = {server} ] && echo "{sans}" || echo "DNS:$name")" > extensions
  openssl req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -keyout "$name.key" -out request -subj "/CN=$name"
  openssl x509 -req -in request -CA ca.pem -CAkey ca.key -CAcreateserial -days 730 -out "$name.pem" -extfile extensions
  rm request extensions
done
"""


def add(commands: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        commands, "acl", _run, help="who may do what: configurations, and a check", description=_ABOUT, epilog=_EXAMPLES
    )  # fmt: skip
    for role, what in (
        ("robots", "send clouds and poses as themselves, and ask"),
        ("planners", "ask"),
        ("operators", "ask, and change maps and the dictionary"),
    ):
        parser.add_argument(f"--{role}", type=_names, default=(), metavar="ID,...", help=f"they {what}")
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="DIR", help="the folder of the configurations"
    )
    parser.add_argument("--check", action="store_true", help="measure what is in the folder; writes nothing")
    parser.add_argument(
        "--auth", type=Auth, choices=list(Auth), default=Auth.MTLS, metavar="mtls|password",
        help="how they prove who they are [mtls]",
    )  # fmt: skip
    parser.add_argument(
        "--host", default="localhost", metavar="NAME", help="where clients reach the server [localhost]"
    )
    parser.add_argument("--port", type=int, default=7447, help="of the server [7447]")
    parser.add_argument(
        "--listen", metavar="ADDRESS", help="where the server listens [localhost: 127.0.0.1, else 0.0.0.0]"
    )
    parser.add_argument(
        "--root", default=DEFAULT_ROOT, metavar="KEY", help=f"first chunks of all keys [{DEFAULT_ROOT}]"
    )
    parser.add_argument(
        "--at", type=Path, metavar="DIR", help="where the files will lie when they are used [--out]"
    )
    parser.add_argument("--json", action="store_true", help="the check as JSON")


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _run(options: argparse.Namespace) -> int:
    if options.check:
        return _check(options)
    roles = Roles(
        robots=options.robots,
        planners=options.planners,
        operators=options.operators,
        auth=options.auth,
        root=options.root,
    )
    folder: Path = options.out
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name, text in _files(roles, options, _passwords(folder / USERS, roles)).items():
        _write(folder / name, text)
    say(f"{len(roles.everybody) + 1} configurations in {folder}")
    if roles.auth is Auth.MTLS:
        say(f"next: sh {folder / _CERTIFICATES}; then potserver acl --check -o {folder}")
    else:
        say(
            f"next: potserver acl --check -o {folder}. Passwords travel in clear text: only on a network that you trust"
        )
    return EXIT_OK


def _files(roles: Roles, options: argparse.Namespace, passwords: dict[str, str]) -> dict[str, str]:
    """Everything that is written, by name."""
    place = (options.at or options.out).absolute()
    listen = options.listen or ("127.0.0.1" if options.host == "localhost" else "0.0.0.0")
    configs = {SERVER: server_config(roles, place, f"{listen}:{options.port}", Limits())}
    for name in roles.everybody:
        connect = f"{options.host}:{options.port}"
        configs[name] = client_config(roles, place, name, connect, passwords.get(name))
    files = {CONFIG.format(name=name): json.dumps(tree, indent=2) + "\n" for name, tree in configs.items()}
    files[_ROLES] = roles.to_json()
    if roles.auth is Auth.PASSWORD:
        files[USERS] = "".join(f"{user}:{passwords[user]}\n" for user in roles.everybody)
    else:
        hosts = list(dict.fromkeys([options.host, "localhost", "127.0.0.1"]))
        files[_CERTIFICATES] = _SCRIPT.format(
            hosts=", ".join(hosts),
            names=" ".join([SERVER, *roles.everybody]),
            server=SERVER,
            sans=",".join(("IP:" if _is_address(host) else "DNS:") + host for host in hosts),
        )
    return files


def _is_address(host: str) -> bool:
    return ":" in host or host.replace(".", "").isdigit()


def _passwords(file: Path, roles: Roles) -> dict[str, str]:
    """One for everybody: those that there are, and new ones."""
    if roles.auth is not Auth.PASSWORD:
        return {}
    lines = file.read_text().splitlines() if file.exists() else []
    known = dict(line.split(":", 1) for line in lines if ":" in line)
    return {name: known.get(name) or secrets.token_urlsafe(24) for name in roles.everybody}


def _write(path: Path, text: str) -> None:
    """For its owner's eyes only."""
    try:
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(text)
    except OSError as error:
        raise SettingsError(f"cannot write {path}: {error.strerror or error}") from error


def _check(options: argparse.Namespace) -> int:
    from potserver.adapters.access_check import measure

    try:
        roles = Roles.from_json((options.out / _ROLES).read_text())
    except OSError as error:
        raise SettingsError(f"no roles in {options.out}: write them first, without --check") from error
    found = measure(roles, options.out)
    wrong = [finding for finding in found if finding.may != finding.can]
    if options.json:
        say(json.dumps([finding._asdict() for finding in found], indent=1))
    else:
        _print_matrix(found, [*roles.everybody])
        for finding in wrong:
            say(f"{finding.who} {'cannot' if finding.may else 'CAN'} {finding.deed}", sys.stderr)
    return EXIT_OPEN if wrong else EXIT_OK


def _print_matrix(found: Sequence[Any], names: list[str]) -> None:
    from rich.console import Console
    from rich.table import Table

    cells = {(finding.deed, finding.who): finding for finding in found}
    columns = [*names, *dict.fromkeys(finding.who for finding in found if finding.who not in names)]
    table = Table(box=None)
    table.add_column("measured", no_wrap=True)
    for name in columns:
        table.add_column(name)
    for deed in dict.fromkeys(finding.deed for finding in found):
        row = [cells.get((deed, who)) for who in columns]
        table.add_row(deed, *("" if cell is None else _word(cell.may, cell.can) for cell in row))
    Console().print(table)


def _word(may: bool, can: bool) -> str:
    word = "allowed" if can else "denied"
    return word if may == can else f"[bold red]{word.upper()}[/]"
