"""Rendering of the golden scene, which the tests of all clients share."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import msgpack  # pyright: ignore[reportMissingTypeStubs]
import numpy as np
import pytest
from numpy.typing import NDArray

from twinstep import EmbeddedServer, Go2Env, Go2VectorEnv
from twinstep.render import Viewer
from twinstep.render.height_field import HeightField, intersect_field
from twinstep.render.shapes import Shape, shapes_of

GOLDEN = Path(__file__).parents[3] / "protocol" / "golden"


def golden(name: str) -> dict[str, Any]:
    unpack = cast(Callable[[bytes], dict[str, Any]], msgpack.unpackb)  # pyright: ignore[reportUnknownMemberType]
    return unpack((GOLDEN / f"{name}.msgpack").read_bytes())


def scene(**changes: Any) -> dict[str, Any]:
    return {**golden("render_reply"), **changes}


def field(heights: NDArray[np.float32], cell_size: float) -> dict[str, Any]:
    """Return a square height field around the origin, as in a message."""
    rows, columns = heights.shape
    origin = [-0.5 * cell_size * (rows - 1), -0.5 * cell_size * (columns - 1)]
    sent = heights.astype("<f4").tobytes()
    return {"origin": origin, "cell_size": cell_size, "rows": rows, "columns": columns, "heights": sent}


def on_field(heights: NDArray[np.float32], cell_size: float, **changes: Any) -> dict[str, Any]:
    flat = scene()["ground"]
    return scene(ground={**flat, "height_field": field(heights, cell_size)}, **changes)


def moved(by: tuple[float, float, float]) -> dict[str, Any]:
    pose = np.frombuffer(scene()["pose"], dtype="<f4").reshape(-1, 7).copy()
    pose[:, :3] += np.array(by, dtype=np.float32)
    return scene(pose=pose.tobytes())


def empty() -> dict[str, Any]:
    return scene(shapes=[])


def differing(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return np.abs(one.astype(int) - other.astype(int)).max(axis=2) > 10


def test_image_has_the_requested_size_and_type() -> None:
    image = Viewer("rgb_array", width=320, height=200).draw(scene())
    assert (image.shape, image.dtype, image.flags["C_CONTIGUOUS"]) == ((200, 320, 3), np.uint8, True)


def test_robot_and_its_shadow_are_in_the_middle() -> None:
    robot = differing(Viewer("rgb_array").draw(scene()), Viewer("rgb_array").draw(empty()))
    assert 2_000 < robot.sum() < 200_000
    rows, columns = (index.mean() for index in np.nonzero(robot))
    assert 120 < rows < 400
    assert 160 < columns < 480


def test_equal_scenes_give_equal_images() -> None:
    assert np.array_equal(Viewer("rgb_array").draw(scene()), Viewer("rgb_array").draw(scene()))


def test_robot_moves_with_its_pose() -> None:
    viewer = Viewer("rgb_array")
    before, after = (differing(viewer.draw(one), viewer.draw(empty())) for one in (scene(), moved((0.0, 0.0, 0.2))))
    assert np.nonzero(after)[0].min() < np.nonzero(before)[0].min() - 20, "it rose"


def test_camera_follows_the_robot_over_the_ground() -> None:
    viewer = Viewer("rgb_array")
    first = viewer.draw(scene())
    # Far enough for the camera to jump, plus half a tile.
    later = viewer.draw(moved((5.125, 0.0, 0.0)))
    corner = (slice(400, 480), slice(0, 200))
    assert differing(first[corner], later[corner]).mean() > 0.2
    trunk = differing(later, Viewer("rgb_array").draw(moved((5.125, 0.0, -3.0))))
    assert 160 < np.nonzero(trunk)[1].mean() < 480


def test_slope_changes_the_image() -> None:
    slope = scene(ground={"point": [0.0, 0.0, 0.0], "normal": [-0.38941833, 0.0, 0.92106104]})
    assert differing(Viewer("rgb_array").draw(scene()), Viewer("rgb_array").draw(slope)).mean() > 0.2


def test_level_field_looks_like_the_plane() -> None:
    level = on_field(np.zeros((81, 81), dtype=np.float32), 0.25)
    assert differing(Viewer("rgb_array").draw(scene()), Viewer("rgb_array").draw(level)).mean() < 0.02


def test_rays_hit_an_inclined_field_like_the_plane() -> None:
    angle = 0.2
    x = np.linspace(-10.0, 10.0, 81, dtype=np.float32) * np.float32(np.tan(angle))
    rising = HeightField.read(field(np.repeat(x[:, None], 81, axis=1), 0.25))
    across, along = np.meshgrid(np.linspace(-1, 1, 161), np.linspace(-1, 1, 121))
    rays = np.stack([across, along, np.full_like(across, -1)], axis=2).astype(np.float32)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    start = np.array([0.5, -0.5, 1.0], dtype=np.float32)
    normal = np.array([-np.sin(angle), 0.0, np.cos(angle)], dtype=np.float32)
    expected = -(start @ normal) / (rays @ normal)
    assert np.allclose(intersect_field(rising, start, rays), expected, atol=1e-3)


def shape_of(kind: str, size: list[float], mesh: dict[str, Any] | None = None) -> Shape:
    """Return a shape at (0.1, -0.2, 0.3), turned by 90 degrees about x."""
    sent = {"body": 0, "kind": kind, "size": size, "offset": [0.1, -0.2, 0.3, 0.5**0.5, 0.5**0.5, 0, 0], "mesh": mesh}
    still = np.array([0, 0, 0, 1, 0, 0, 0], dtype="<f4").tobytes()
    return shapes_of({"pose": still, "shapes": [sent]})[0]


def rays(seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return starts and unit directions, (200, 3) each, towards the shape and past it."""
    random = np.random.default_rng(seed)
    starts = random.normal(size=(200, 3)) * 2
    towards = random.normal(size=(200, 3)) * 0.3 - starts
    return starts.astype(np.float32), (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)


def test_convex_mesh_of_a_cube_is_hit_where_the_box_is() -> None:
    half = [0.2, 0.3, 0.4]
    points = [[x * half[0], y * half[1], z * half[2]] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[a, b, c] for a, b, c in ([s[0], s[i], s[i + 1]] for s in sides for i in (1, 2))]
    cube, box = shape_of("convex", [0, 0, 0], {"points": points, "faces": faces}), shape_of("box", half)
    assert cube.planes is not None
    assert len(cube.planes[0]) == 6, "two triangles of a side have one plane"
    starts, directions = rays(1)
    towards = box.centre + (starts - starts.mean(axis=0)) * 0.2 - starts[0]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    beside = box.centre + starts * 0.2 - 3 * directions[0]
    for start, ray in ((starts[:1], towards), (beside, directions[:1])):
        expected = box.intersect(start, ray)
        hit = np.isfinite(expected)
        assert 20 < hit.sum() < 180
        assert np.allclose(cube.intersect(start, ray), expected, atol=1e-4)
        at = (start + ray * expected[:, None])[hit]
        assert np.allclose(cube.normal(at), box.normal(at), atol=1e-4)


def test_rays_end_on_the_side_or_at_an_end_of_a_cylinder() -> None:
    cylinder = shape_of("cylinder", [0.25, 0.4, 0])
    starts, directions = rays(2)
    distances = np.concatenate([cylinder.intersect(s[None], d[None]) for s, d in zip(starts, directions, strict=True)])
    hit = np.isfinite(distances)
    assert 20 < hit.sum() < 180
    at = ((starts + directions * distances[:, None])[hit] - cylinder.centre) @ cylinder.axes
    radius, height = np.linalg.norm(at[:, :2], axis=1), np.abs(at[:, 2])
    assert np.all((np.abs(radius - 0.25) < 1e-3) & (height < 0.401) | (np.abs(height - 0.4) < 1e-3) & (radius < 0.251))
    assert np.all(
        (cylinder.normal((starts + directions * distances[:, None])[hit]) * directions[hit]).sum(axis=1) < 0.01
    )


def test_height_field_is_drawn_and_hides_the_robot() -> None:
    rough = scene(ground=golden("render_reply_rough")["ground"])
    assert differing(Viewer("rgb_array").draw(scene()), Viewer("rgb_array").draw(rough)).mean() > 0.05
    heights = np.zeros((41, 41), dtype=np.float32)
    # A hill between the robot at (0.5, 0) and the camera at its front right.
    heights[22:26, 17] = 0.6
    hidden, seen = (
        differing(Viewer("rgb_array").draw(on_field(one, 0.2)), Viewer("rgb_array").draw(on_field(one, 0.2, shapes=[])))
        for one in (heights, np.zeros_like(heights))
    )
    assert hidden.sum() < 0.8 * seen.sum(), "a hill hides a part of the robot"


def test_error_names_the_unknown_mode() -> None:
    with pytest.raises(ValueError, match="`mode` = 'ansi'"):
        Viewer("ansi")  # pyright: ignore[reportArgumentType]


def test_window_shows_the_same_image(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    viewer = Viewer("human", width=160, height=120, fps=1000)
    image = viewer.draw(scene())
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, image)
    viewer.close()
    viewer.close()


def test_error_without_pygame_has_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ImportError, match=r'pip install "twinstep\[render\]"'):
        Viewer("human")
    assert len(Viewer("rgb_array").draw(scene())) == 480


def test_frame_rate_is_that_of_the_policy(tmp_path: Path) -> None:
    robots = Path(__file__).parents[3] / "data" / "robots"
    model = tmp_path / "fast.toml"
    model.write_text(f'robot = "{robots / "go1.urdf"}"\n[control]\npolicy_hz = 100.0\n')
    with Go2Env() as env:
        assert env.metadata["render_fps"] == 50
    envs = Go2VectorEnv(1, model=str(model))
    assert (envs.twinstep_spec.policy_dt, envs.metadata["render_fps"]) == (0.01, 100)
    envs.close()


def test_window_without_pygame_leaves_no_server_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    before = dict(EmbeddedServer._shared)  # pyright: ignore[reportPrivateUsage]
    monkeypatch.setattr(importlib, "import_module", missing)
    for make in (Go2Env, Go2VectorEnv):
        with pytest.raises(ImportError, match="needs pygame"):
            make(render_mode="human", task="counter")
    assert before == EmbeddedServer._shared  # pyright: ignore[reportPrivateUsage]
