"""Documents that are generated from the spec of the server."""

from pathlib import Path

from twinstep import Go2VectorEnv
from twinstep.tables import tables


def test_page_of_the_walk_task_is_up_to_date() -> None:
    page = Path(__file__).parents[3] / "docs" / "go2-walk.md"
    envs = Go2VectorEnv(1, critic=True)
    assert page.read_text() == tables(envs.twinstep_spec), "update it: python -m twinstep.tables > docs/go2-walk.md"
    envs.close()
