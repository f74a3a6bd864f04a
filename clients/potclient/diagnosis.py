"""Why a session could not be opened. Zenoh says "unable to connect" whatever the cause: here the endpoint is tried by hand."""

from __future__ import annotations

import contextlib
import json
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

_CONNECT_S = 2.0
_TLS = "transport/link/tls"
_FILES = ("root_ca_certificate", "connect_certificate", "connect_private_key")


class Cause(NamedTuple):
    """What is wrong at an endpoint."""

    is_refused: bool  # somebody is there and does not let us in; else nobody answers
    text: str


def missing_file(config: zenoh.Config) -> str | None:
    """The first file of certificates or keys that the configuration names and that cannot be read, in words."""
    for key in (*_FILES, "listen_certificate", "listen_private_key"):
        path = _value(config, f"{_TLS}/{key}")
        if path is None:
            continue
        try:
            Path(path).read_bytes()
        except OSError as error:
            return f"cannot read {path} ({_TLS}/{key}): {error.strerror or error}"
    return None


def cause_of(config: zenoh.Config, endpoint: str) -> Cause:
    """What keeps a client with this configuration from an endpoint."""
    protocol, _, address = endpoint.split("#", 1)[0].partition("/")
    host, _, port = address.split("?", 1)[0].rpartition(":")
    if protocol not in ("tcp", "tls") or not port.isdigit():
        return Cause(False, f"or {endpoint} does not let this client in")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S) as connection:
            return _greeted(config, endpoint, protocol, host, connection)
    except socket.gaierror as error:
        return Cause(False, f"the name is not known: {error.strerror}")
    except TimeoutError:
        return Cause(False, f"no answer within {_CONNECT_S:g} s: the host is down, or a firewall is between")
    except OSError as error:
        return Cause(False, str(error.strerror or error))


def _greeted(
    config: zenoh.Config, endpoint: str, protocol: str, host: str, connection: socket.socket
) -> Cause:
    connection.settimeout(_CONNECT_S)
    if protocol == "tls":
        return Cause(True, f"{endpoint}: {_tls_problem(config, host, connection)}")
    if _speaks_tls(connection):
        return Cause(
            True, f"{endpoint} speaks TLS: connect to tls/... with the site's certificates (-c FILE)"
        )
    user = _value(config, "transport/auth/usrpwd/user")
    if user is not None:
        return Cause(True, f"{endpoint} does not let {user!r} in: the user or the password is wrong")
    return Cause(
        True,
        f"somebody listens at {endpoint} and does not let this client in: it wants a user and a password (-c FILE),"
        " has as many sessions as it may, is too busy to answer, or is no Zenoh node",
    )


def _tls_problem(config: zenoh.Config, host: str, connection: socket.socket) -> str:
    """What goes wrong when TLS is begun as Zenoh would."""
    authority, certificate, key = (_value(config, f"{_TLS}/{name}") for name in _FILES)
    try:
        context = ssl.create_default_context(cafile=authority)
        context.check_hostname = _value(config, f"{_TLS}/verify_name_on_connect") is not False
        if certificate is not None:
            context.load_cert_chain(certificate, key)
        with context.wrap_socket(connection, server_hostname=host.strip("[]")) as secured:
            secured.recv(1)  # what a server thinks of our certificate comes after the handshake
    except ssl.SSLCertVerificationError as error:
        return (
            f"the server's certificate is not accepted ({error.verify_message}): is root_ca_certificate that of the site's"
            " authority, and is the host's name in the server's certificate?"
        )
    except ssl.SSLError as error:
        reason = str(error.reason or error)
        if "WRONG_VERSION" in reason or "RECORD_LAYER" in reason:
            return "it does not speak TLS: connect to tcp/..."
        if certificate is None:
            return f"it wants a certificate of this client ({reason}): name one with -c FILE"
        return f"it does not accept the certificate {certificate} ({reason}): is it of the site's authority, and in date?"
    except TimeoutError:
        return (
            "the certificates are accepted, or nobody speaks TLS there, and Zenoh was not let in all the same"
        )
    except OSError as error:
        return f"the connection was cut while TLS began ({error.strerror or error}): it may not speak TLS"
    return "the connection was closed after TLS began"


def _speaks_tls(connection: socket.socket) -> bool:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with contextlib.suppress(ssl.SSLError, OSError), context.wrap_socket(connection):
        return True
    return False


def _value(config: zenoh.Config, key: str) -> Any:
    with contextlib.suppress(zenoh.ZError, ValueError):
        return json.loads(config.get_json(key))
    return None


def endpoints_of(config: zenoh.Config) -> Iterator[str]:
    """Where a configuration connects to."""
    listed = _value(config, "connect/endpoints") or []
    for each in listed.get(_value(config, "mode")) or [] if isinstance(listed, dict) else listed:
        yield str(each)
