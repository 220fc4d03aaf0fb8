"""Options of a connection, and the flags of the bundled server that follow from them."""

from dataclasses import dataclass

from .errors import InvalidOptionError

UNLIMITED = 2**32 - 1
"""``max_episode_steps`` that never truncates."""

_CAPACITY = "1000000"


@dataclass(frozen=True)
class ConnectOptions:
    """Options of a connection, common to all environments.

    Attributes
    ----------
    endpoint
        Zenoh endpoint of a server, a robot or a router. ``None`` starts the bundled server.
    robot
        With ``endpoint``: name of the robot, required if several are visible. Among several servers of the same robot,
        task and spec hash, that with the most free environments is chosen. Without: robot of the bundled server, a
        shipped one (``"go2"``, ``"g1"``, ``twinstep serve --help``) or its model file.
    task
        Name of the task. A server at ``endpoint`` must have this task.
    config, model
        Config file and model file of the bundled server (``twinstep serve --help``). Not allowed with ``endpoint``.
    zenoh_config
        Zenoh configuration file (JSON5) for TLS, user and password.
    shared_memory
        Sends large messages through shared memory. The server must run on this machine with the flag
        ``--shared-memory``, which the bundled server gets; otherwise the messages are sent over the network.
    spec_hash
        Spec hash for which the agent was trained. A server with a different hash is rejected.
    critic
        Requests the privileged observations of group ``critic``; they are in the info of every reset and step.
    timeout_s, reset_timeout_s
        Timeout of a step and of a reset [s].
    connect_timeout_s
        Timeout of connecting to a server and finding the robot [s].
    """

    endpoint: str | None = None
    robot: str | None = None
    task: str = "walk"
    config: str | None = None
    model: str | None = None
    zenoh_config: str | None = None
    shared_memory: bool = False
    spec_hash: str | None = None
    critic: bool = False
    timeout_s: float = 5.0
    reset_timeout_s: float = 10.0
    connect_timeout_s: float = 5.0

    def __post_init__(self) -> None:
        """Check the options that do not depend on a server."""
        if self.endpoint is not None and (self.config is not None or self.model is not None):
            raise InvalidOptionError("`config` and `model` are options of the bundled server: omit them or `endpoint`")
        if self.endpoint is None and self.robot is not None and self.model is not None:
            raise InvalidOptionError("`robot` and `model` are both the robot of the bundled server: omit one of them")
        for name in ("timeout_s", "reset_timeout_s", "connect_timeout_s"):
            value = getattr(self, name)
            if not value > 0:
                raise InvalidOptionError(f"`{name}` = {value} s; must be greater than 0")


def server_flags(options: ConnectOptions) -> tuple[str, ...]:
    """Return the flags of ``twinstep serve`` for the bundled server."""
    flags = ["--task", options.task, "--envs", _CAPACITY]
    if options.config is not None:
        flags += ["--config", options.config]
    model = options.robot if options.model is None else options.model
    if model is not None:
        flags += ["--model", model]
    if options.shared_memory:
        flags.append("--shared-memory")
    return tuple(flags)
