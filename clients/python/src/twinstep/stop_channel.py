"""The stop channel of a robot: a TCP connection of its own, beside Zenoh (SPEC.md, "Stop channel")."""

import contextlib
import hashlib
import hmac
import json
import socket
import ssl
from typing import Any

import zenoh

_MAGIC = b"TWSTOP1\n"
_PURPOSE = b"twinstep-stop"
_GREETING_BYTES = 40
_STOPPED = b"S"
_TIMEOUT_S = 1.0


def answer(greeting: bytes, user: str, password: str) -> bytes:
    """Return what a client answers to the greeting of a robot.

    Parameters
    ----------
    greeting
        The 40 bytes that the robot sends first.
    user, password
        Empty if the robot has no users.
    """
    if len(greeting) != _GREETING_BYTES or not greeting.startswith(_MAGIC):
        raise ConnectionError("no robot listens at this port")
    name = user.encode()
    message = _PURPOSE + greeting[len(_MAGIC) :] + name
    return bytes([len(name)]) + name + hmac.digest(password.encode(), message, hashlib.sha256)


def stop_over_channel(endpoint: str, zenoh_config: str | None, port: int | None = None) -> None:
    """Damp the motors of the robot at a Zenoh endpoint. Raises OSError if its stop channel does not confirm it.

    Parameters
    ----------
    endpoint
        Zenoh endpoint of the robot.
    zenoh_config
        Zenoh configuration file with user, password and certificates.
    port
        Port of the channel, from ``hello``. Default: the one after that of the endpoint.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, zenoh_port = address.rpartition(":")
    if not zenoh_port.isdigit():
        raise ConnectionError(f"the endpoint {endpoint} has no port")
    host = host.strip("[]")
    config = zenoh.Config.from_file(zenoh_config) if zenoh_config else zenoh.Config()
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(socket.create_connection((host, port or int(zenoh_port) + 1), _TIMEOUT_S))
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if protocol in ("tls", "quic"):
            stream = stack.enter_context(_tls_context(config).wrap_socket(stream, server_hostname=host))
        user = _setting(config, "transport/auth/usrpwd/user") or ""
        password = _setting(config, "transport/auth/usrpwd/password") or ""
        stream.sendall(answer(_receive(stream, _GREETING_BYTES), user, password))
        if _receive(stream, 1) != _STOPPED:
            raise ConnectionError("the robot refuses user or password")


def _receive(stream: socket.socket, size: int) -> bytes:
    received = b""
    while len(received) < size:
        part = stream.recv(size - len(received))
        if not part:
            raise ConnectionError("the robot closed the connection")
        received += part
    return received


def _setting(config: zenoh.Config, key: str) -> str | None:
    value: Any = json.loads(config.get_json(key))
    return value if isinstance(value, str) and value else None


def _tls_context(config: zenoh.Config) -> ssl.SSLContext:
    def file(key: str) -> str | None:
        return _setting(config, f"transport/link/tls/{key}")

    context = ssl.create_default_context(cafile=file("root_ca_certificate"))
    certificate, key = file("connect_certificate"), file("connect_private_key")
    if certificate and key:
        context.load_cert_chain(certificate, key)
    return context
