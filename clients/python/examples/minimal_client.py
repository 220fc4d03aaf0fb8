"""Step robots with only Zenoh and MessagePack, as in ``protocol/SPEC.md``: a template for other languages."""

import argparse
import secrets
import struct
import time
import uuid
from typing import Any, cast

import msgpack as untyped_msgpack
import zenoh

msgpack: Any = untyped_msgpack
ENVS, STEPS, TIMEOUT_S = 2, 10, 20.0
SECRET = secrets.token_bytes(16)
"""Attached to every request: nobody else can use the environments."""
NONE = zenoh.ConsolidationMode.NONE


def send_request(session: zenoh.Session, key: str, **request: object) -> dict[str, Any]:
    """Send a request and repeat it until a reply arrives; its number makes the repeats harmless."""
    payload, deadline = msgpack.packb({"protocol": 1, **request}), time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        for reply in session.get(key, payload=payload, attachment=SECRET, consolidation=NONE, timeout=2.0):
            if reply.ok:
                return msgpack.unpackb(reply.ok.payload.to_bytes())
            error = cast(zenoh.ReplyError, reply.err).payload.to_bytes()
            # An error of Zenoh is the text "Timeout"; an error reply of Twinstep is a map.
            if error[0] >= 0x80 and not (reply := msgpack.unpackb(error))["retryable"]:
                raise RuntimeError(f"{reply['code']}: {reply['message']}\n  {reply['hint']}")
        time.sleep(0.05)
    raise TimeoutError(f"no reply at {key}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("endpoint", help="such as tcp/127.0.0.1:7447")
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{parser.parse_args().endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        servers = session.liveliness().get("twinstep/live/server/*/*")
        (server_id,) = {str(reply.ok.key_expr).split("/")[3] for reply in servers if reply.ok}
        low, high = send_request(session, f"twinstep/{server_id}/hello", client="minimal_client.py")["protocols"]
        assert low <= 1 <= high, f"the server supports protocol {low} to {high}, this client 1"
        client = uuid.uuid4().hex
        token = session.liveliness().declare_token(f"twinstep/live/client/{server_id}/{client}")
        lease = send_request(session, f"twinstep/{server_id}/lease", client=client, num_envs=ENVS, autoreset="NextStep")
        env, epoch, seq = f"twinstep/{server_id}/env/{lease['lease']}", lease["epoch"], lease["last_seq"] + 1
        send_request(session, f"{env}/reset", epoch=epoch, seq=seq, seeds=struct.pack(f"<{ENVS}Q", *range(ENVS)))
        entries = ENVS * sum(part["size"] for part in lease["spec"]["action"])
        for _ in range(STEPS):
            seq += 1
            step = send_request(
                session, f"{env}/step", epoch=epoch, seq=seq, actions=struct.pack(f"<{entries}f", *[0] * entries)
            )
            print(*struct.unpack(f"<{ENVS}f", step["reward"]))
        send_request(session, f"{env}/close", epoch=epoch, seq=seq + 1)
        token.undeclare()


if __name__ == "__main__":
    main()
