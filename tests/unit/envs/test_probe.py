"""Problems and remarks of environments that are played before training."""

from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from music_rllib.envs import probe
from music_rllib.envs.probe import Probe, Question
from music_rllib.envs.tasks import Task


class Sound(gym.Env[Any, Any]):
    """A point with a goal."""

    action_space = spaces.Box(-1, 1, (2,), np.float32)
    observation_space: spaces.Space[Any] = spaces.Dict(
        {name: spaces.Box(-9, 9, (2,)) for name in ("observation", "achieved_goal", "desired_goal")}
    )

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -(np.linalg.norm(achieved - desired, axis=-1) > 0.1).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.at, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        return self.seen(), {}

    def seen(self) -> Any:
        return {"observation": self.at, "achieved_goal": self.at, "desired_goal": self.goal}

    def step(self, action: Any) -> Any:
        self.at = self.at + 0.1 * action
        reward = float(self.compute_reward(self.at, self.goal, {}))
        return self.seen(), reward, False, False, {"is_success": reward == 0}


def probed(
    monkeypatch: pytest.MonkeyPatch,
    kind: type[Sound],
    *,
    hindsight: bool = False,
    intrinsic: bool = False,
    rewards: tuple[str, ...] = (),
    **task: Any,
) -> Probe:
    monkeypatch.setattr(probe, "MOST_STEPS", 3000)
    monkeypatch.setattr(probe, "MOST_SECONDS", 60.0)  # on a busy machine too
    # A new id: Gymnasium warns about an id that is registered twice.
    name = f"Probed{kind.__name__}{id(kind)}-v0"
    gym.register(name, entry_point=lambda **_: kind(), max_episode_steps=20)
    try:
        declared = Task(name="T", env_id=name, horizon=20, **task)
        asked = Question(
            task=declared, hindsight=("all",) * hindsight, intrinsic=intrinsic, rewards=rewards
        )
        made = Probe(asked, lambda call: None)
        made.run()
    finally:
        del gym.registry[name]
    return made


def changed(step: Callable[..., Any]) -> type[Sound]:
    """An environment whose step returns something else."""

    class Changed(Sound):
        def step(self, action: Any) -> Any:
            return step(self, *super().step(action))

    return Changed


def test_rewards_about_goals_need_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    class OneGoal(Sound):
        goals: ClassVar = {
            name: spaces.Box(-9, 9, (1,)) for name in ("achieved_goal", "desired_goal")
        }
        observation_space = spaces.Dict({"observation": spaces.Box(-9, 9, (2,)), **goals})

        def seen(self) -> Any:
            found = super().seen()
            return {name: found[name][:1] if "goal" in name else found[name] for name in found}

    made = probed(monkeypatch, OneGoal, rewards=("diayn", "discern", "rnd"))
    (line,) = made.problems
    assert line.startswith("must have goals of 2 dimensions or more for intrinsic.reward diayn")


def test_a_sound_environment_has_no_problems_or_remarks(monkeypatch: pytest.MonkeyPatch) -> None:
    made = probed(monkeypatch, Sound, hindsight=True)
    assert (made.problems, made.remarks) == ([], [])


def test_ends_at_the_goal_need_a_function_of_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = changed(lambda env, seen, reward, *rest: (seen, reward, reward == 0, *rest[1:]))
    made = probed(monkeypatch, ends, hindsight=True)
    assert made.problems == []
    assert made.remarks == [
        "step() terminates episodes; if it does so at the goal, hindsight needs "
        "compute_terminated(achieved_goal, desired_goal, info), or relabeled transitions do not "
        "end at their new goal"
    ]
    assert probed(monkeypatch, ends).remarks == []

    class Ends(ends):  # type: ignore[misc,valid-type]
        reached = 0.0

        def compute_terminated(self, *goals: Any) -> Any:
            return self.compute_reward(*goals) == self.reached

    made = probed(monkeypatch, Ends, hindsight=True)
    assert (made.problems, made.remarks) == ([], [])
    Ends.reached = -1.0
    (problem,) = probed(monkeypatch, Ends, hindsight=True).problems
    assert "episodes continue where compute_terminated is True" in problem


def test_intrinsic_rewards_make_an_early_end_attractive(monkeypatch: pytest.MonkeyPatch) -> None:
    falls = changed(lambda env, *step: (*step[:2], abs(env.at[0]) > 0.5, *step[3:]))
    (remark,) = probed(monkeypatch, falls, intrinsic=True).remarks
    assert "a policy earns more of them by ending an episode early" in remark
    assert probed(monkeypatch, falls).remarks == []
    assert probed(monkeypatch, Sound, intrinsic=True).remarks == []


def test_symmetries_without_the_goal_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = {"mirror": {"positions": [0], "goal": [0], "action": [0]}}
    assert probed(monkeypatch, Sound, symmetries=whole).remarks == []
    lacking = {"translate": [{"positions": [0], "distance": 0.1}]}
    (remark,) = probed(monkeypatch, Sound, symmetries=lacking).remarks
    assert "no entry of the goal" in remark


class Progress(Sound):
    """Its reward depends on the call before, which nothing but hindsight forbids."""

    before = 0.0

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        now = np.linalg.norm(achieved - desired, axis=-1)
        before, self.before = self.before, float(np.mean(now))
        return before - now


def test_a_reward_of_more_than_goals_may_have_symmetries(monkeypatch: pytest.MonkeyPatch) -> None:
    assert probed(monkeypatch, Progress).problems == []
    whole = {"mirror": {"positions": [0], "goal": [0], "action": [0]}}
    assert probed(monkeypatch, Progress, symmetries=whole).problems == []


class HoldIt(Sound):
    """Goals begin a thousandth of a coordinate away from the achieved ones."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        _, info = super().reset(seed=seed)
        self.at = self.at + 2.0
        self.goal = self.at + self.np_random.uniform(-1e-4, 1e-4, 2)
        return self.seen(), info

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -np.linalg.norm(np.subtract(achieved, desired, dtype=np.float64), axis=-1)


def test_goals_may_begin_near_the_achieved_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    assert probed(monkeypatch, HoldIt, hindsight=True).problems == []


def bonus(env: Sound, seen: Any, reward: float, *rest: Any) -> Any:
    return seen, reward + 10.0 * (reward == 0), *rest


def cost(env: Sound, seen: Any, reward: float, *rest: Any) -> Any:
    return seen, reward - 1e-3 * abs(float(env.at[0])), *rest


def old_step(env: Sound, seen: Any, reward: float, done: bool, _: bool, info: Any) -> Any:
    return seen, reward, done, info


def says(value: Any) -> Callable[..., Any]:
    return lambda env, *step: (*step[:4], {"is_success": value})


def stops(env: Sound, *step: Any) -> Any:
    raise SystemExit(3)


class SmallSeeds(Sound):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        if seed is not None and not 5 <= seed < 100:
            raise IndexError(f"level {seed} is not there")
        return super().reset(seed=seed)


class OldReset(Sound):
    def reset(self, **arguments: Any) -> Any:
        return super().reset(**arguments)[0]


class Double(Sound):
    def __init__(self) -> None:
        torch.set_default_dtype(torch.float64)


class OneNumber(Sound):
    def seen(self) -> Any:
        return super().seen() | {"achieved_goal": np.float32(1)}


@pytest.mark.parametrize(
    ("kind", "problem"),
    [
        (changed(bonus), "a step returned reward 10, compute_reward gives 0"),
        (changed(cost), "compute_reward is not the whole reward of a step"),
        (
            changed(old_step),
            "step() must return (observation, reward, terminated, truncated, info)",
        ),
        (changed(says("False")), "info['is_success'] must be a bool, or the number 0 or 1, got 'F"),
        (changed(says(0.7)), "step 1: info['is_success'] must be a bool, or the number 0 or 1"),
        (changed(stops), "step() must not raise, it raised SystemExit: 3 ("),
        (OldReset, "reset() must return (observation, info) with a dictionary info"),
        (OneNumber, "achieved_goal must have shape (2,), as its space declares"),
        (Double, "PyTorch's default type must stay float32, the type of the networks, got float64"),
        (SmallSeeds, "reset(seed=0) must not raise, it raised IndexError: level 0 is not there"),
    ],
)
def test_an_environment_that_would_fail_in_training_is_refused(
    kind: type[Sound], problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (line,) = probed(monkeypatch, kind, hindsight=True).problems
    assert problem in line


def test_both_ends_of_the_seed_range_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not probed(monkeypatch, SmallSeeds, hindsight=True, seed_range=(5, 99)).problems
    (line,) = probed(monkeypatch, SmallSeeds, seed_range=(5, 100)).problems
    assert line.startswith("reset must accept all seeds of seed_range, 5 to 100: reset(seed=100)")
    assert line.endswith("seed_range: [5, N] declares N as the largest")
    (line,) = probed(monkeypatch, SmallSeeds).problems
    assert line.startswith("reset(seed=0) must not raise, it raised IndexError")
    assert line.endswith("declare them with seed_range: [SMALLEST, LARGEST]")


class OwnSeeds(Sound):
    def reset(self, **arguments: Any) -> Any:
        return super().reset()


class Unseeded(Sound):
    def step(self, action: Any) -> Any:
        return super().step(action + np.random.default_rng().uniform(-0.1, 0.1, 2))


class Extra(Sound):
    def seen(self) -> Any:
        return super().seen() | {"force": np.ones(3)}


class Truncated(Sound):
    def seen(self) -> Any:
        return super().seen() | {"observation": self.at.astype(int)}


class Stubborn(Sound):
    def close(self) -> None:
        raise RuntimeError("it is\ngone")


@pytest.mark.parametrize(
    ("kind", "remark"),
    [
        (OwnSeeds, "must determine the episode; the second time it differed from step 0 on"),
        (
            Unseeded,
            "must determine the episode; the second time it differed from step 1 on",
        ),
        (Extra, "the observation's force is not used"),
        (Truncated, "observation has type int64, its space declares float32"),
        (Stubborn, "close() must not raise, it raised RuntimeError: it is gone ("),
        (
            changed(lambda env, *step: (*step[:4], {"is_success": True} if step[1] == 9 else {})),
            "success_key 'is_success' was not in info in 3000 random steps (keys: none)",
        ),
        (changed(lambda env, *step: (*step[:4], {"success": 1})), "(did you mean 'success'?)"),
    ],
)
def test_other_findings_are_remarks(
    kind: type[Sound], remark: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = probed(monkeypatch, kind)
    assert made.problems == []
    (line,) = made.remarks
    assert remark in line


def test_a_success_key_that_only_a_success_has_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def rare(env: Sound, *step: Any) -> Any:
        return *step[:4], {"is_success": True} if step[1] == 0 else {}

    made = probed(monkeypatch, changed(rare))
    assert (made.problems, made.remarks) == ([], [])


def test_a_misspelled_success_key_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = probed(monkeypatch, Sound, success_key="is_succes").problems
    assert line.endswith("(is_success), got 'is_succes' (did you mean 'is_success'?)")


def test_arguments_are_not_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    radii = []

    class Pops(Sound):
        def __init__(self, config: dict[str, float], name: str, function: str) -> None:
            radii.append((config.pop("radius", None), name, function))

    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    gym.register("Pops-v0", entry_point=lambda **given: Pops(**given), max_episode_steps=20)
    kwargs = {"config": {"radius": 0.5}, "name": "a", "function": "b"}
    task = Task(name="T", env_id="Pops-v0", horizon=20, env_kwargs=kwargs)
    made = Probe(Question(task=task), lambda call: None)
    made.run()
    assert made.problems == []
    assert radii == [(0.5, "a", "b")] * 2
    assert task.env_kwargs == kwargs


class OnlyOne(Sound):
    made = 0

    def __init__(self) -> None:
        OnlyOne.made += 1
        if OnlyOne.made > 1:
            raise RuntimeError("port 5005 is in use")


class Shared(Sound):
    world: ClassVar[dict[str, Any]] = {}
    at = property(lambda env: env.world["at"], lambda env, at: env.world.update(at=at))


class NewRadius(Sound):
    """A success radius that is drawn at each reset."""

    def reset(self, **options: Any) -> Any:
        found = super().reset(**options)
        self.radius = self.np_random.uniform(0.05, 0.6)
        return found

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -(np.linalg.norm(achieved - desired, axis=-1) > self.radius).astype(np.float32)


class NewBounds(Sound):
    def reset(self, **options: Any) -> Any:
        found = super().reset(**options)
        self.action_space = spaces.Box(-self.np_random.uniform(1, 2), 1, (2,), np.float32)
        return found


class LateSpaces(Sound):
    action_space = property(lambda env: env.bounds)

    def reset(self, **options: Any) -> Any:
        self.bounds = spaces.Box(-1, 1, (2,), np.float32)
        return super().reset(**options)


class NoAction(Sound):
    action_space = spaces.Box(-1, 1, (0,), np.float32)


class SharedClock(Sound):
    """The steps of an episode are counted in the class."""

    clock = 0

    def reset(self, **options: Any) -> Any:
        SharedClock.clock = 0
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        SharedClock.clock += 1
        seen, reward, terminated, _, info = super().step(action)
        return seen, reward, terminated, SharedClock.clock >= 20, info


class OneReward(Sound):
    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return np.mean(super().compute_reward(achieved, desired, info))


@pytest.mark.parametrize(
    ("kind", "problem"),
    [
        (OnlyOne, "need several environments in one process: the second time, make must not raise"),
        (Shared, "environments in one process must not share state, as several are trained on"),
        (SharedClock, "environments in one process must not share state"),
        (NewRadius, "rewards of the same goals change from episode to episode"),
        (NewBounds, "spaces must stay the same after reset(), got Box(-1.0, 1.0, (2,), float32)"),
        (LateSpaces, "must have action_space and observation_space before reset()"),
        (NoAction, "must be a bounded one-dimensional Box of one or more floats"),
        (OneReward, "256 goals have rewards of shape ()"),
    ],
)
def test_an_environment_whose_numbers_would_be_wrong_is_refused(
    kind: type[Sound], problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (line,) = probed(monkeypatch, kind, hindsight=True).problems
    assert problem in line


class Holds(Sound):
    def seen(self) -> Any:
        return super().seen() | {"observation": np.array([self.at[0], self.goal[1] - self.at[1]])}


class HoldsDense(Holds):
    """Random steps have different rewards at once, so that few episodes are played."""

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -np.linalg.norm(achieved - desired, axis=-1)


class FarAway(Sound):
    def seen(self) -> Any:
        return super().seen() | {"observation": self.at + np.array([5.4e6, 0])}


class Drawn(Sound):
    """The size of a step is drawn when the environment is made."""

    def __init__(self) -> None:
        self.size = np.random.default_rng().uniform(0.5, 1.0)

    def step(self, action: Any) -> Any:
        return super().step(self.size * action)


class GlobalGenerator(Sound):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        np.random.seed(seed)  # noqa: NPY002
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        return super().step(action + np.random.uniform(-0.1, 0.1, 2))  # noqa: NPY002


class TorchGenerator(Sound):
    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        torch.manual_seed(seed or 0)
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        return super().step(action + 0.1 * torch.randn(2).numpy())


class Longer(Sound):
    """Each episode is one step longer."""

    episodes = 0

    def reset(self, **options: Any) -> Any:
        self.episodes, self.steps = self.episodes + 1, 0
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        self.steps += 1
        seen, reward, _, truncated, info = super().step(action)
        return seen, reward, self.steps == self.episodes, truncated, info


class Lucky(Sound):
    """Success depends on the episodes before."""

    calls = 0

    def step(self, action: Any) -> Any:
        self.calls += 1
        *rest, _ = super().step(action)
        return *rest, {"is_success": self.calls % 7 == 0}


class FarGoals(Sound):
    def seen(self) -> Any:
        return {name: value + 5.4e6 * ("goal" in name) for name, value in super().seen().items()}


@pytest.mark.parametrize(
    ("kind", "remark"),
    [
        (TorchGenerator, "beside a second environment it differed from step 1 on"),
        (GlobalGenerator, "beside a second environment it differed from step 1 on"),
        (Holds, "observation[1] holds desired_goal[1] or its distance from the achieved goal"),
        (HoldsDense, "observation[1] holds desired_goal[1] or its distance"),
        (FarAway, "observation[0] changes too little for its size: float32"),
        (Drawn, "a second environment's differed from step 1 on"),
        (Longer, "the second time it differed from step 2 on"),
        (Lucky, "the second time it differed from step 2 on"),
        (FarGoals, "desired_goal[0] changes too little for its size: float32"),
        (
            changed(lambda env, seen, reward, *rest: (seen, 1e9 - abs(env.at[0]), *rest)),
            "rewards change too little for their size: float32",
        ),
    ],
)
def test_values_that_networks_cannot_learn_from_are_remarks(
    kind: type[Sound], remark: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = probed(monkeypatch, kind, hindsight=issubclass(kind, Holds))
    assert made.problems == []
    (line,) = made.remarks
    assert remark in line


def test_a_reward_range_contains_the_rewards_that_are_played(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert probed(monkeypatch, Sound, reward_range=(-1, 0)).problems == []
    (line,) = probed(monkeypatch, Sound, reward_range=(-0.5, 0)).problems
    assert line.startswith("reward_range must contain every reward, got [-0.5, 0]: random steps")


def test_bool_goals_are_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    class Bools(Sound):
        goals = spaces.Box(0, 1, (2,), bool)  # type: ignore[arg-type]
        observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-9, 9, (2,)),
                "achieved_goal": goals,
                "desired_goal": goals,
            }
        )

        def seen(self) -> Any:
            goals = {"achieved_goal": self.at > 0, "desired_goal": self.goal > 0}
            return {"observation": self.at, **goals}

        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
            return -(np.asarray(achieved) != np.asarray(desired)).any(axis=-1).astype(np.float32)

        def step(self, action: Any) -> Any:
            seen, *_, info = super().step(action)
            reward = self.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})
            return seen, float(reward), False, False, info

    assert probed(monkeypatch, Bools, hindsight=True).problems == []


def test_a_limit_inside_is_the_environments_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A registered function returns a wrapped `gymnasium.make(...)`, whose limit stays."""

    class Limited(Sound):
        def __new__(cls) -> Any:
            env = object.__new__(cls)
            return gym.wrappers.TimeLimit(env, 10)

    (line,) = probed(monkeypatch, Limited, env_kwargs={"max_episode_steps": 20}).problems
    assert line == "horizon must be <= 10, the environment's own limit, got 20"
