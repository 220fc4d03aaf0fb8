"""Robots simulated by MuJoCo, in lock-step with a program that sends their commands.

``python -m twinstep.mujoco`` is the process behind ``engine = "mujoco"`` of a Twinstep server. It reads requests from
its stdin and writes replies to its stdout, both as the frames of :mod:`.frames`. It terminates when its stdin closes.

The program is at the level of motors. A command per robot, with joint targets and gains, is held for some actuator
periods. The reply has the sensor readings, and apart from them the ground truth.
"""
