"""Recording of a policy as images and as a video."""

import re
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from twinstep import record

POLICY = Path(__file__).parents[3] / "data/policies/walk.safetensors"


def decoded(content: bytes) -> np.ndarray:
    """Return the pixels of a PNG without filters, from its own chunks."""
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = dict[bytes, bytes](), 8
    while at < len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        kind, data = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        assert struct.unpack(">I", content[at + 8 + length : at + 12 + length]) == (zlib.crc32(kind + data),)
        chunks[kind], at = data, at + 12 + length
    width, height = struct.unpack(">II", chunks[b"IHDR"][:8])
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, 1 + 3 * width)
    assert not rows[:, 0].any()
    return rows[:, 1:].reshape(height, width, 3)


def test_png_has_the_pixels() -> None:
    image = np.random.default_rng(1).integers(256, size=(7, 5, 3), dtype=np.uint8)
    np.testing.assert_array_equal(decoded(record.png(image)), image)


def test_walking_robot_is_recorded_as_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "frames"
    record.main([str(POLICY), "--png", str(folder), "--seconds", "0.4", "--velocity", "1", "0", "0"])
    images = [decoded(path.read_bytes()) for path in sorted(folder.iterdir())]
    assert len(images) == 20
    assert images[0].shape == (480, 640, 3)
    assert (images[0] != images[-1]).any(axis=2).mean() > 0.005, "the robot has moved"
    assert capsys.readouterr().out == f"20 images in {folder}\n"


def test_video_gets_every_image_and_errors_of_ffmpeg_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = [np.full((4, 6, 3), value, np.uint8) for value in range(5)]
    program = tmp_path / "ffmpeg"
    script = "import sys; open(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())"
    program.write_text(f"#!{sys.executable}\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    video = tmp_path / "walk.mp4"
    assert record.write_video(iter(images), video, fps=50) == 5
    assert video.read_bytes() == b"".join(image.tobytes() for image in images)
    program.write_text(f"#!{sys.executable}\nimport sys; sys.exit('no such codec')\n")
    with pytest.raises(record.RecordError, match="ffmpeg has failed: no such codec"):
        record.write_video(iter(images), video, fps=50)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(record.RecordError, match=re.escape("or write images with `--png DIR`")):
        record.write_video(iter(images), video, fps=50)


def test_file_that_is_no_policy_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"text that is longer than eight bytes"):
        (tmp_path / "policy.safetensors").write_bytes(content)
        with pytest.raises(SystemExit, match="is not a policy file"):
            record.main([str(tmp_path / "policy.safetensors"), "--png", str(tmp_path / "frames")])
    assert not (tmp_path / "frames").exists()
