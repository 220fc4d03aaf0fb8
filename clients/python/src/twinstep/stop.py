"""Stop of a robot, by anyone who sees it."""

from .connection import Connection
from .stop_channel import stop_over_channel


def stop_robot(
    endpoint: str,
    *,
    robot: str | None = None,
    zenoh_config: str | None = None,
    timeout_s: float = 5.0,
) -> None:
    """Damp the motors of a robot at once, whoever controls it.

    It needs no environment and passes every queue: the stop goes over a connection of its own, and over Zenoh if that
    does not confirm it. The robot lies down, and its operator arms it again. A server that
    simulates raises :class:`~twinstep.RequestRejectedError`.

    Parameters
    ----------
    endpoint
        Zenoh endpoint of ``twinstep robot``, such as ``tcp/192.168.1.20:7447``.
    robot
        Name of the robot. Required if several are visible.
    zenoh_config
        Zenoh configuration file (JSON5) for TLS, user and password.
    timeout_s
        Timeout of connecting, and of the reply [s].
    """
    try:
        stop_over_channel(endpoint, zenoh_config)
    except OSError:
        pass
    else:
        return
    connection = Connection(endpoint, robot=robot, zenoh_config=zenoh_config, server=None, connect_timeout_s=timeout_s)
    try:
        connection.request("stop", {}, timeout_s, "timeout_s")
    finally:
        connection.close()
