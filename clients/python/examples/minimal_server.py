"""Host a Gymnasium environment behind ``protocol/SPEC.md``: a template for servers in other languages."""

import argparse
import hashlib
import hmac
import re
import secrets
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import zenoh
from minimal_server_task import Episodes, describe, spec_hash
from minimal_server_wire import PROTOCOL, Message, RequestError, decode, encode, limited, optional, read

GRACE_S, MAX_CONTROL_BYTES = 10.0, 4096
MSGPACK = zenoh.Encoding("application/msgpack")


@dataclass
class Lease:
    """Environments of one client, and the last request that was executed."""

    lease: str
    client: str
    secret: bytes
    autoreset: str
    episodes: Episodes
    spec: Message
    epoch: int = 1
    last_seq: int = 0
    last_method: str = ""
    last_reply: bytes = b""
    # None after a reclaim: the new owner may repeat the last request without its content.
    last_digest: bytes | None = b""
    last_used: float = field(default_factory=time.monotonic)

    def reply(self) -> bytes:
        """Return the reply to a lease request."""
        names = ("epoch", "autoreset", "last_seq", "spec")
        return encode(
            lease=self.lease, num_envs=len(self.episodes.envs), **{name: getattr(self, name) for name in names}
        )

    def execute(self, method: str, message: Message, payload: bytes) -> bytes:
        """Execute the next request; a repeated one gets the stored reply."""
        seq, digest = read(message, "seq", int), hashlib.sha256(payload).digest()
        if seq == self.last_seq and method == self.last_method and self.last_digest in (None, digest):
            return self.last_reply
        if seq <= self.last_seq:
            raise RequestError(
                "stale_sequence", "seq", f"`seq` = {seq} was answered before: the last is {self.last_seq}"
            )
        if seq > self.last_seq + 1:
            raise RequestError("sequence_gap", "seq", f"`seq` = {seq} skips a number: the last is {self.last_seq}")
        run: dict[str, Callable[[Message], Message]] = {"reset": self.episodes.reset, "step": self.episodes.step}
        reply = encode(seq=seq, **(run[method](message) if method in run else {}))
        self.last_seq, self.last_method, self.last_reply, self.last_digest = seq, method, reply, digest
        return reply


class Server:
    """Answers the requests of all clients, one after the other."""

    def __init__(self, env_id: str, max_envs: int, live: "Clients") -> None:
        # The server truncates episodes, because a lease may have another limit than the environment.
        self.make: Callable[[], Any] = lambda: gymnasium.make(env_id, max_episode_steps=-1)
        self.name = re.sub("[^A-Za-z0-9_-]", "-", env_id)[:64]
        self.server_id, self.max_envs, self.live, self.env_steps = secrets.token_hex(8), max_envs, live, 0
        env: Any = gymnasium.make(env_id)
        self.spec, self.leases = describe(self.name, env), dict[str, Lease]()
        env.close()
        self.row_bytes = 4 * max(3, sum(part["size"] for part in self.spec["action"]))

    def answer(self, key: str, payload: bytes, secret: bytes) -> bytes:
        """Execute a request and return the reply. Raises ``RequestError``."""
        self.expire()
        match key.split("/")[2:]:
            case ["hello"]:
                return self.hello(decode(limited(payload, MAX_CONTROL_BYTES), any_version=True))
            case ["lease"]:
                return self.lease(decode(limited(payload, MAX_CONTROL_BYTES)), secret)
            case ["env", lease_id, "reset" | "step" | "close" | "render" as method]:
                return self.execute(lease_id, method, payload, secret)
            case _:
                raise RequestError("unknown_key", "", f"the key `{key}` does not exist")

    def free_envs(self) -> int:
        """Return the number of environments that are not leased."""
        return self.max_envs - sum(len(lease.episodes.envs) for lease in self.leases.values())

    def hello(self, _: Message) -> bytes:
        """Answer ``hello``, in any version."""
        return encode(
            protocols=[PROTOCOL, PROTOCOL],
            server_version="minimal_server.py",
            name=self.name,
            server_id=self.server_id,
            spec=self.spec,
            spec_hash=spec_hash(self.spec),
            max_envs=self.max_envs,
            free_envs=self.free_envs(),
            max_envs_per_client=self.max_envs,
            max_request_bytes=MAX_CONTROL_BYTES + self.max_envs * self.row_bytes,
            lease_grace_s=GRACE_S,
            env_steps=self.env_steps,
        )

    def lease(self, message: Message, secret: bytes) -> bytes:
        """Grant a lease, or return the one that this client already has."""
        client, num_envs = read(message, "client", str), read(message, "num_envs", int)
        autoreset, max_steps = read(message, "autoreset", str), optional(message, "max_episode_steps", int)
        wanted = optional(message, "spec_hash", str)
        if not re.fullmatch("[A-Za-z0-9_-]{1,64}", client):
            raise RequestError("out_of_range", "client", "`client` must be 1 to 64 of A-Z a-z 0-9 - _")
        if num_envs < 1 or max_steps == 0:
            raise RequestError("out_of_range", "num_envs" if num_envs < 1 else "max_episode_steps", "0 is not allowed")
        if autoreset not in ("NextStep", "SameStep", "Disabled"):
            raise RequestError("malformed", "autoreset", f"`autoreset` = {autoreset}")
        if wanted not in (None, spec_hash(self.spec)):
            raise RequestError(
                "spec_mismatch", "spec_hash", f"`spec_hash` = {wanted}; it is {spec_hash(self.spec)} here"
            )
        if len(secret) != 16:
            raise RequestError("malformed", "secret", "the attachment is not a secret of 16 bytes")
        if reclaim := optional(message, "reclaim", dict):
            return self.reclaim(read(reclaim, "lease", str), read(reclaim, "epoch", int), client, secret)
        for held in self.leases.values():
            if held.secret == secret and (held.client, len(held.episodes.envs)) == (client, num_envs):
                return held.reply()
            if held.secret == secret:
                raise RequestError("out_of_range", "secret", "this secret has a lease already")
        if num_envs > self.free_envs():
            raise RequestError("too_many_envs", "num_envs", f"{self.free_envs()} of {self.max_envs} are free")
        max_steps = max_steps or self.spec["max_episode_steps"]
        episodes = Episodes(self.make, num_envs, autoreset, max_steps)
        spec = {**self.spec, "max_episode_steps": max_steps}
        lease = Lease(secrets.token_hex(8), client, secret, autoreset, episodes, spec)
        self.leases[lease.lease] = lease
        return lease.reply()

    def find(self, lease_id: str, secret: bytes) -> Lease:
        """Return the lease, if the request has its secret. The error does not say which of the two is wrong."""
        lease = self.leases.get(lease_id)
        if lease is None or not hmac.compare_digest(lease.secret, secret):
            raise RequestError(
                "lease_lost", "lease", "there is no such lease, or the attached secret is not its secret"
            )
        lease.last_used = time.monotonic()
        return lease

    def reclaim(self, lease_id: str, epoch: int, client: str, secret: bytes) -> bytes:
        """Give a lease to another process that has its secret."""
        lease = self.find(lease_id, secret)
        if (lease.client, lease.epoch) != (client, epoch + 1):  # otherwise a repeated reclaim
            if epoch != lease.epoch:
                raise RequestError("stale_epoch", "reclaim.epoch", f"the epoch is {lease.epoch}")
            lease.client, lease.epoch, lease.last_digest = client, epoch + 1, None
        return lease.reply()

    def execute(self, lease_id: str, method: str, payload: bytes, secret: bytes) -> bytes:
        """Execute a request below ``env/<lease>``."""
        lease = self.find(lease_id, secret)
        message = decode(limited(payload, MAX_CONTROL_BYTES + len(lease.episodes.envs) * self.row_bytes))
        if read(message, "epoch", int) != lease.epoch:
            raise RequestError("stale_epoch", "epoch", f"the epoch of this lease is {lease.epoch}")
        if method == "render":
            raise RequestError("unknown_key", "", "this server has nothing to render")
        seq = lease.last_seq
        try:
            reply = lease.execute(method, message, payload)
        except RequestError:
            raise
        except Exception as error:
            traceback.print_exc()
            self.remove(lease_id)
            raise RequestError("lease_lost", "lease", f"an environment of this lease failed: {error}") from error
        if method == "step" and lease.last_seq != seq:
            self.env_steps += len(lease.episodes.envs)
        if method == "close":
            self.remove(lease_id)
        return reply

    def expire(self) -> None:
        """Release the leases of clients that are disconnected for longer than the grace period."""
        now = time.monotonic()
        for lease_id, lease in list(self.leases.items()):
            if now - max(lease.last_used, self.live.last_seen(lease.client, now)) > GRACE_S:
                self.remove(lease_id)

    def remove(self, lease_id: str) -> None:
        """Release a lease and close its environments."""
        for env in self.leases.pop(lease_id).episodes.envs:
            env.close()


class Clients:
    """Liveliness tokens of clients."""

    def __init__(self) -> None:
        self.gone_since: dict[str, float] = {}
        self.present: set[str] = set()

    def update(self, sample: zenoh.Sample) -> None:
        """Record that a token appeared or disappeared. Called by a thread of Zenoh."""
        client = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.PUT:
            self.present.add(client)
        else:
            self.gone_since[client] = time.monotonic()
            self.present.discard(client)

    def last_seen(self, client: str, now: float) -> float:
        """Return the time at which the token was visible last [s]."""
        return now if client in self.present else self.gone_since.get(client, 0.0)


def reply_to(query: zenoh.Query, answer: Callable[[str, bytes, bytes], bytes]) -> None:
    """Answer one query."""
    payload, attachment = query.payload, query.attachment
    # Leaving the block ends the query at the client.
    with query:
        try:
            reply = answer(
                str(query.key_expr),
                payload.to_bytes() if payload else b"",
                attachment.to_bytes() if attachment else b"",
            )
            query.reply(query.key_expr, reply, encoding=MSGPACK)
        except RequestError as error:
            query.reply_err(error.reply, encoding=MSGPACK)


def refuse(*_: object) -> bytes:
    """Answer a request during the shutdown."""
    raise RequestError("shutting_down", "", "the server is shutting down; nothing was executed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="Pendulum-v1", help="id of a Gymnasium environment")
    parser.add_argument("--envs", type=int, default=64, help="maximum number of environments of all clients")
    parser.add_argument("--listen", default="tcp/127.0.0.1:7447", help="Zenoh endpoint")
    arguments = parser.parse_args()
    config, live = zenoh.Config(), Clients()
    for key, value in (
        ("mode", '"peer"'),
        ("listen/endpoints", f'["{arguments.listen}"]'),
        ("scouting/multicast/enabled", "false"),
        ("transport/link/tx/lease", "2000"),
    ):
        config.insert_json5(key, value)
    server = Server(arguments.env, arguments.envs, live)
    with zenoh.open(config) as session:
        queries = session.declare_queryable(f"twinstep/{server.server_id}/**", complete=True)
        liveliness = session.liveliness()
        subscriber = liveliness.declare_subscriber(
            f"twinstep/live/client/{server.server_id}/*", live.update, history=True
        )
        # Last: a client that finds the server can use it.
        token = liveliness.declare_token(f"twinstep/live/server/{server.server_id}/{server.name}")
        print(f"listening {arguments.listen}", flush=True)
        try:
            for query in queries:
                reply_to(query, server.answer)
        except KeyboardInterrupt:
            token.undeclare()
            while (query := queries.try_recv()) is not None:
                reply_to(query, refuse)
        subscriber.undeclare()


if __name__ == "__main__":
    main()
