"""Observation and action tables from a server's spec: ``python -m twinstep.tables > docs/go2-walk.md``."""

from .codec import SpecField, Spec
from .vector_env import Go2VectorEnv


def tables(spec: Spec) -> str:
    """Write the Markdown page of a task."""
    head = f"""# {spec.robot.capitalize()}, task `{spec.task}`

Made by `python -m twinstep.tables` from the server's spec; a test keeps it true.

One step is one policy period of {spec.policy_dt:g} s; the actuator runs at {1 / spec.actuator_dt:g} Hz with
kp = {spec.kp:g} N·m/rad and kd = {spec.kd:g} N·m·s/rad. An action of 1 offsets a joint by {spec.action_scale:g} rad
from the default pose.
Episodes are truncated after {spec.max_episode_steps} steps.
"""
    parts = [("Observation", spec.observation, spec.obs_len), ("Action", spec.action, spec.action_len)]
    sections = [f"## {name}: {size} × float32\n\n{_table(part)}" for name, part, size in parts]
    joints = "\n".join(
        f"| {index} | `{joint}` | {angle:g} |"
        for index, (joint, angle) in enumerate(zip(spec.joint_order, spec.default_pose, strict=True))
    )
    order = f"## Joints\n\n| index | joint | default pose [rad] |\n|---|---|---|\n{joints}\n"
    rewards = "## Reward terms\n\n" + "".join(f"- `{name}`\n" for name in spec.reward_terms)
    return "\n".join([head, *sections, order, rewards])


def _table(parts: tuple[SpecField, ...]) -> str:
    rows, start = list[str](), 0
    for part in parts:
        index = f"{start}" if part.size == 1 else f"{start}–{start + part.size - 1}"
        rows.append(f"| {index} | `{part.name}` | {part.unit or '–'} | {part.low:g} | {part.high:g} | {part.description} |")
        start += part.size
    return "| index | name | unit | low | high | meaning |\n|---|---|---|---|---|---|\n" + "\n".join(rows) + "\n"


if __name__ == "__main__":
    envs = Go2VectorEnv(1)
    print(tables(envs.twinstep_spec), end="")
    envs.close()
