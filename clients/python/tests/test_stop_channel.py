"""The stop channel: golden bytes, and services that are no robot."""

import socket
import threading
from pathlib import Path

import pytest

from twinstep.stop_channel import answer, stop_over_channel

GOLDEN = Path(__file__).parents[3] / "protocol" / "golden" / "stop_channel.bin"


def test_answer_has_its_golden_bytes() -> None:
    golden = GOLDEN.read_bytes()
    greeting, expected = golden[:40], golden[40:]
    assert answer(greeting, "alice", "change-me-1") == expected
    assert answer(greeting, "alice", "Change-me-1") != expected


def test_other_services_are_no_robots() -> None:
    with pytest.raises(ConnectionError, match="no robot"):
        answer(b"SSH-2.0" * 6, "", "")
    with pytest.raises(ConnectionError, match="has no port"):
        stop_over_channel("tcp/localhost", None)


def test_refusal_is_an_error_and_a_confirmation_is_none() -> None:
    golden = GOLDEN.read_bytes()[:40]
    for reply in (b"S", b"R"):
        with socket.create_server(("127.0.0.1", 0)) as listener:

            def serve(listener: socket.socket = listener, reply: bytes = reply) -> None:
                stream, _ = listener.accept()
                with stream:
                    stream.sendall(golden)
                    stream.recv(1024)
                    stream.sendall(reply)

            thread = threading.Thread(target=serve)
            thread.start()
            port = listener.getsockname()[1]
            if reply == b"S":
                stop_over_channel("tcp/127.0.0.1:7447", None, port)
            else:
                with pytest.raises(ConnectionError, match="refuses"):
                    stop_over_channel("tcp/127.0.0.1:7447", None, port)
            thread.join()
