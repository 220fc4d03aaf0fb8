"""A picture shows the robot where the scene has it. The scene is the one that every client's tests read."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import msgpack  # pyright: ignore[reportMissingTypeStubs]
import numpy as np
import pytest
from numpy.typing import NDArray

from twinstep.render import Viewer

GOLDEN = Path(__file__).parents[3] / "protocol" / "golden" / "render_reply.msgpack"


def scene(**changes: Any) -> dict[str, Any]:
    unpack = cast(Callable[[bytes], dict[str, Any]], msgpack.unpackb)  # pyright: ignore[reportUnknownMemberType]
    return {**unpack(GOLDEN.read_bytes()), **changes}


def moved(by: tuple[float, float, float]) -> dict[str, Any]:
    pose = np.frombuffer(scene()["pose"], dtype="<f4").reshape(-1, 7).copy()
    pose[:, :3] += np.array(by, dtype=np.float32)
    return scene(pose=pose.tobytes())


def empty() -> dict[str, Any]:
    return scene(shapes=[])


def differing(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return np.abs(one.astype(int) - other.astype(int)).max(axis=2) > 10


def test_picture_has_the_asked_for_size_and_type() -> None:
    image = Viewer("rgb_array", width=320, height=200).draw(scene())
    assert (image.shape, image.dtype, image.flags["C_CONTIGUOUS"]) == ((200, 320, 3), np.uint8, True)


def test_robot_and_its_shadow_stand_out_in_the_middle() -> None:
    robot = differing(Viewer("rgb_array").draw(scene()), Viewer("rgb_array").draw(empty()))
    assert 2_000 < robot.sum() < 200_000
    rows, columns = (index.mean() for index in np.nonzero(robot))
    assert 120 < rows < 400
    assert 160 < columns < 480


def test_equal_scenes_give_equal_pictures() -> None:
    assert np.array_equal(Viewer("rgb_array").draw(scene()), Viewer("rgb_array").draw(scene()))


def test_robot_moves_when_its_pose_does() -> None:
    viewer = Viewer("rgb_array")
    before, after = (differing(viewer.draw(one), viewer.draw(empty())) for one in (scene(), moved((0.0, 0.0, 0.2))))
    assert np.nonzero(after)[0].min() < np.nonzero(before)[0].min() - 20, "it rose"


def test_camera_follows_and_the_ground_passes_by() -> None:
    viewer = Viewer("rgb_array")
    first = viewer.draw(scene())
    # Far enough for the camera to jump, and half a tile of the chequer on.
    later = viewer.draw(moved((5.125, 0.0, 0.0)))
    corner = (slice(400, 480), slice(0, 200))
    assert differing(first[corner], later[corner]).mean() > 0.2
    trunk = differing(later, Viewer("rgb_array").draw(moved((5.125, 0.0, -3.0))))
    assert 160 < np.nonzero(trunk)[1].mean() < 480


def test_ground_rises_with_the_slope() -> None:
    slope = scene(ground={"point": [0.0, 0.0, 0.0], "normal": [-0.38941833, 0.0, 0.92106104]})
    assert differing(Viewer("rgb_array").draw(scene()), Viewer("rgb_array").draw(slope)).mean() > 0.2


def test_unknown_mode_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="`mode` = 'ansi'"):
        Viewer("ansi")  # pyright: ignore[reportArgumentType]


def test_window_shows_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    viewer = Viewer("human", width=160, height=120, fps=1000)
    image = viewer.draw(scene())
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, image)
    viewer.close()
    viewer.close()


def test_missing_pygame_is_named_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ImportError, match=r'pip install "twinstep\[render\]"'):
        Viewer("human")
    assert len(Viewer("rgb_array").draw(scene())) == 480
