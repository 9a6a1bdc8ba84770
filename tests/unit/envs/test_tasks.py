"""Built-in tasks, and tasks that a user declares."""

import pytest
from pydantic import ValidationError

from music_rllib.envs.features import Symmetries
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task, closest

FETCH = {name: task for name, task in BUILT_IN_TASKS.items() if name.startswith("Fetch")}


def test_built_in_fetch_tasks_have_the_split_of_the_paper() -> None:
    assert list(FETCH) == ["FetchReach", "FetchPush", "FetchPickAndPlace", "FetchSlide"]
    for name, task in FETCH.items():
        assert (task.env_id, task.horizon, task.success_key) == (f"{name}-v4", 50, "is_success")
        if name != "FetchReach":
            assert task.agent_indices == (0, 1, 2)
            assert task.surrounding_indices == (3, 4, 5)
    assert not BUILT_IN_TASKS["FetchReach"].has_split
    weights = {name: task.mi_reward_weight for name, task in BUILT_IN_TASKS.items()}
    assert weights["FetchSlide"] == 0.5
    assert weights["FetchPush"] == 1.0


def test_a_range_is_a_list_of_indices() -> None:
    task = Task.model_validate_json(
        '{"name": "T", "env_id": "E-v0", "horizon": 9, "agent_indices": "2:4",'
        ' "surrounding_indices": [7, 5]}',
        strict=True,
    )
    assert task.agent_indices == (2, 3)
    assert task.surrounding_indices == (7, 5)
    assert Task.model_validate_json(task.model_dump_json(), strict=True) == task


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"agent_indices": "a:b"}, "range such as 0:3"),
        ({"agent_indices": "3:0"}, "range such as 0:3, got '3:0'"),
        ({"agent_indices": [0, 0]}, "must not repeat"),
        ({"agent_indices": [3]}, "must not overlap"),
        ({"agent_indices": []}, "agent_indices must be given too"),
        ({"surrounding_indices": "5:5"}, "surrounding_indices must be given too"),
        ({"agent_indices": [-1]}, "greater than or equal to 0"),
        ({"horizon": 0}, "greater than 0"),
        ({"name": "../up"}, "match pattern"),
        ({"mi_reward_weight": float("nan")}, "finite"),
        ({"horizn": 5}, "Extra inputs"),
    ],
)
def test_unsound_tasks_are_rejected(change: dict[str, object], rule: str) -> None:
    sound = {
        "name": "T",
        "env_id": "E-v0",
        "horizon": 10,
        "agent_indices": [0, 1],
        "surrounding_indices": [3, 4],
    }
    Task.model_validate(sound)
    with pytest.raises(ValidationError, match=rule):
        Task.model_validate(sound | change)


def test_identity_ignores_settings_that_do_not_change_the_environment() -> None:
    push = BUILT_IN_TASKS["FetchPush"]
    trained_otherwise = {
        "mi_reward_weight": 0.3, "moved_distance": 0.02, "symmetries": Symmetries()
    }  # fmt: skip
    renamed = push.model_copy(update={"name": "Mine", **trained_otherwise})
    assert renamed.identity() == push.identity()
    for change in (
        {"env_id": "FetchSlide-v4"},
        {"horizon": 49},
        {"agent_indices": (0, 1)},
        {"surrounding_indices": (3, 4)},
        {"success_key": None},
        {"seed_range": (0, 99)},
        {"env_kwargs": {"reward_type": "dense"}},
    ):
        assert push.model_copy(update=change).identity() != push.identity()


def test_a_task_with_the_default_seeds_keeps_the_identity_of_runs_without_this_setting() -> None:
    assert "seed_range" not in BUILT_IN_TASKS["FetchPush"].identity()


def test_the_limit_of_steps_is_an_integer() -> None:
    """YAML reads 1e2 as a float, which Gymnasium refuses."""
    given = {"name": "P", "env_id": "FetchPush-v4", "horizon": 5}
    kwargs = {"max_episode_steps": 1e2, "distance": 1e2}
    task = Task.model_validate({**given, "env_kwargs": kwargs})
    assert repr(task.env_kwargs) == "{'max_episode_steps': 100, 'distance': 100.0}"


@pytest.mark.parametrize(("name", "hint"), [("hiden", "'hidden'"), ("zzz", "")])
def test_closest_suggests_only_similar_names(name: str, hint: str) -> None:
    text = closest(name, ["hidden", "lr"])
    assert hint in text
    assert bool(hint) == bool(text)
