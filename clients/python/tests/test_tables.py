"""The pages of entries are those of the server."""

from pathlib import Path

import pytest

import twinstep
from twinstep.tables import tables


@pytest.mark.parametrize("task", ["walk", "track", "jump", "gait", "attitude", "getup"])
def test_page_is_up_to_date(task: str) -> None:
    page = Path(__file__).parents[3] / f"docs/go2-{task}.md"
    envs = twinstep.Go2VectorEnv(1, critic=True, task=task)
    command = f"python -m twinstep.tables {task} > docs/go2-{task}.md"
    assert page.read_text() == tables(envs.twinstep_spec), f"update it: {command}"
    envs.close()
