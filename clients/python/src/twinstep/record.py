"""Record a walking robot: ``python -m twinstep.record walk.safetensors --png frames``, or ``--video walk.mp4``.

The robot is that of a simulation in this computer, or of a server (``--endpoint``). There is one image per policy step.
"""

import argparse
import json
import shutil
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .env import Go2Env
from .errors import Error

Array = NDArray[np.float32]
Image = NDArray[np.uint8]


class RecordError(Error, ValueError):
    """The recording is not possible; the message contains the reason."""


@dataclass(frozen=True)
class MeanPolicy:
    """Mean action of a policy of ``twinstep train``."""

    task: str
    layers: list[tuple[Array, Array]]
    mean: Array
    std: Array

    @classmethod
    def read(cls, path: Path) -> "MeanPolicy":
        """Read a policy file: the length of the header, the header as JSON, the arrays.

        Raises
        ------
        RecordError
            The file is not a policy file of ``twinstep train``.
        """
        try:
            content = path.read_bytes()
            start = 8 + int.from_bytes(content[:8], "little")
            header = json.loads(content[8:start])
            task = json.loads(header.pop("__metadata__")["policy"])["spec"]["task"]
            arrays = {name: _array(content[start:], entry) for name, entry in header.items()}
            count = sum(name.startswith("actor.") for name in arrays) // 2
            layers = [(arrays[f"actor.{one}.weight"], arrays[f"actor.{one}.bias"]) for one in range(count)]
            return cls(task, layers, arrays["normaliser.mean"], arrays["normaliser.std"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise RecordError(f"{path} is not a policy file (*.safetensors) of `twinstep train`: {error!r}") from error

    def action(self, obs: Array) -> Array:
        """Return the mean action, clipped to -1 to 1, for one observation."""
        values = np.clip((obs - self.mean) / self.std, -10, 10)
        for index, (weight, bias) in enumerate(self.layers):
            values = weight @ (np.maximum(values, 0) if index > 0 else values) + bias
        return np.clip(values, -1, 1).astype(np.float32)


def _array(content: bytes, entry: dict[str, Any]) -> Array:
    first, end = entry["data_offsets"]
    return np.frombuffer(content[first:end], "<f4").reshape(entry["shape"])


def frames(
    policy: MeanPolicy, *, steps: int, velocity: Sequence[float] | None, options: dict[str, Any]
) -> Iterator[Image]:
    """Yield an image, (480, 640, 3) uint8, after every policy step. A fall starts a new episode."""
    env = Go2Env(render_mode="rgb_array", task=policy.task, **options)
    try:
        if velocity is not None:
            env.set_velocity_command(np.array(velocity, np.float32))
        obs, _ = env.reset(seed=1)
        for _ in range(steps):
            obs, _, terminated, truncated, _ = env.step(policy.action(obs))
            image = env.render()
            assert image is not None
            yield image
            if terminated or truncated:
                obs, _ = env.reset()
    finally:
        env.close()


def png(image: Image) -> bytes:
    """Return an image, (height, width, 3) uint8, as PNG."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width, _ = image.shape
    # Each row begins with the number of its filter; 0: none.
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, 3 * width)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def write_frames(images: Iterable[Image], folder: Path) -> int:
    """Write images as ``00000.png`` and so on. Returns their number."""
    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    for image in images:
        (folder / f"{count:05}.png").write_bytes(png(image))
        count += 1
    return count


def write_video(images: Iterable[Image], path: Path, *, fps: float) -> int:
    """Write images as a video, whose format is that of the file name. Returns their number.

    Raises
    ------
    RecordError
        There is no ffmpeg, or it has failed; the message contains what it printed.
    """
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        raise RecordError("there is no ffmpeg on the PATH\n  install it, or write images with `--png DIR`")
    iterator = iter(images)
    first = next(iterator)
    height, width, _ = first.shape
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    # Players expect this format of colours in an MP4; a GIF has a palette.
    colours = [] if path.suffix.lower() == ".gif" else ["-pix_fmt", "yuv420p"]
    command = [ffmpeg, "-y", "-loglevel", "error", *given, *colours, str(path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdin is not None
    count = 0
    try:
        for image in chain([first], iterator):
            process.stdin.write(image.tobytes())
            count += 1
    except BrokenPipeError:
        pass
    finally:
        _, printed = process.communicate()
    if process.returncode != 0:
        raise RecordError(f"ffmpeg has failed: {printed.decode(errors='replace').strip()}")
    return count


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m twinstep.record", description=__doc__)
    parser.add_argument("policy", type=Path, help="policy.safetensors of `twinstep train`")
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("--png", type=Path, metavar="DIR", help="folder for one PNG per image")
    target.add_argument("--video", type=Path, metavar="FILE", help="*.mp4 or *.gif; needs ffmpeg")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--velocity", type=float, nargs=3, metavar=("VX", "VY", "WZ"), help="default: the task's own")
    parser.add_argument("--endpoint", help="server or robot; default: a simulation in this computer")
    args = parser.parse_args(arguments)
    try:
        policy = MeanPolicy.read(args.policy)
        steps = max(1, round(args.seconds / 0.02))
        images = frames(policy, steps=steps, velocity=args.velocity, options={"endpoint": args.endpoint})
        count = write_frames(images, args.png) if args.png else write_video(images, args.video, fps=50)
    except Error as error:
        sys.exit(f"error: {error}")
    print(f"{count} images in {args.png or args.video}")


if __name__ == "__main__":
    main()
