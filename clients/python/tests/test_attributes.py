"""Attributes and methods of the single robots of a vector environment, by name as in ``SyncVectorEnv``."""

from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest

import twinstep
from twinstep import Go2VectorEnv


@pytest.fixture
def robots() -> Iterator[Go2VectorEnv]:
    envs = gym.make_vec("twinstep/Go2-Walk-v0", num_envs=3, render_mode="rgb_array")
    assert isinstance(envs, Go2VectorEnv)
    envs.reset(seed=1)
    yield envs
    envs.close()


def test_get_attr_returns_one_value_per_robot(robots: Go2VectorEnv) -> None:
    assert robots.get_attr("render_mode") == ("rgb_array",) * 3
    assert [spec.id for spec in robots.get_attr("spec")] == ["twinstep/Go2-Walk-v0"] * 3
    assert robots.get_attr("action_space") == (robots.single_action_space,) * 3
    assert robots.get_attr("index") == (0, 1, 2)


def test_call_of_render_returns_the_image_of_each_robot(robots: Go2VectorEnv) -> None:
    images = robots.call("render")
    assert [image.shape for image in images] == [(480, 640, 3)] * 3
    assert robots.call("render_mode") == ("rgb_array",) * 3, "an attribute is returned, as by SyncVectorEnv"


def test_call_of_reset_starts_every_robot_with_the_same_seed(robots: Go2VectorEnv) -> None:
    results = robots.call("reset", seed=5)
    for obs, info in results:
        np.testing.assert_array_equal(obs, results[0][0])
        assert info == {}


def test_an_attribute_that_was_set_belongs_to_one_robot(robots: Go2VectorEnv) -> None:
    robots.set_attr("level", [1, 2, 3])
    assert robots.get_attr("level") == (1, 2, 3)
    robots.set_attr("level", 7)
    assert robots.get_attr("level") == (7, 7, 7)
    with pytest.raises(twinstep.InvalidOptionError, match="`values` has 2 entries; 3 are expected"):
        robots.set_attr("level", (1, 2))
    for fixed, words in (("twinstep_spec", "is the same for all robots"), ("index", "`index` cannot be set")):
        with pytest.raises(AttributeError, match=words):
            robots.set_attr(fixed, None)


def test_error_of_an_unknown_attribute_names_those_that_exist(robots: Go2VectorEnv) -> None:
    robots.set_attr("level", 1)
    for method in (robots.get_attr, robots.call):
        with pytest.raises(AttributeError, match=r"no attribute `gravity`; it has index, reset, render, spec, .*level"):
            method("gravity")


def test_reset_of_one_robot_returns_its_privileged_observation() -> None:
    envs = Go2VectorEnv(2, critic=True)
    _, infos = envs.reset(seed=3)
    _, info = envs.sub_env(1).reset(seed=4)
    np.testing.assert_array_equal(info["critic_obs"], infos["critic_obs"][1])
    envs.close()
