"""The environment runner on real environments: whole episodes, seeds, goals, action bounds."""

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from ray.rllib.callbacks.callbacks import RLlibCallback

from music_rllib.envs.values import BadNumberError
from music_rllib.tac.algorithm import TACConfig
from music_rllib.tac.env_runner import SUCCESS_LAST, TrajectoryEnvRunner, colored_noise
from music_rllib.tac.networks import RunningNormaliser


class Countdown(gym.Env[Any, Any]):
    """Terminates after a number of steps given by its seed; action bounds are not -1 and 1."""

    observation_space = gym.spaces.Box(-100.0, 100.0, (2,))
    action_space = gym.spaces.Box(
        np.array([-3.0, 10.0], np.float32), np.array([1.0, 30.0], np.float32)
    )

    def __init__(self, config: Any = None) -> None:
        self.seen: list[np.ndarray] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(2, 9))
        return np.array([self.left, 0.0], np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.seen.append(action)
        self.left -= 1
        return np.array([self.left, 1.0], np.float32), 1.0, self.left == 0, False, {}


class SaysSuccessAtTheEnd(Countdown):
    """Reports success only in episodes that terminate."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        *step, _ = super().step(action)
        return (*step, {"is_success": True} if self.left == 0 else {})


NOISE = {"kind": "gaussian_noise", "std": 0.05, "random_share": 0.3}


def runner(
    env: Any = "FetchPush-v4",
    *,
    evaluation: bool = False,
    seed: int = 0,
    missing: bool | None = None,
    callbacks: dict[str, Any] | None = None,
    **settings: Any,
) -> TrajectoryEnvRunner:
    config = TACConfig().environment(env).debugging(seed=seed).callbacks(**(callbacks or {}))
    config.env_runners(num_envs_per_env_runner=settings.pop("num_envs", 2))
    config.music(**{k: settings.pop(k) for k in list(settings) if k in ("goals",)})
    if env == "FetchPush-v4":
        config.agent_indices, config.surrounding_indices = (0, 1, 2), (3, 4, 5)
    config.training(hidden_sizes=(8,), **settings)
    config.in_evaluation = evaluation
    config.success_if_missing = missing
    return TrajectoryEnvRunner(
        config=config, worker_index=0, num_workers=0, env_creator=lambda context: env(context)
    )


def test_fetch_episodes_are_whole_and_aligned() -> None:
    first, second = runner().sample(random_actions=True)
    for episode in (first, second):
        assert episode.frames.shape == (51, 31)
        assert episode.actions.shape == (50, 4)
        assert not episode.terminated
        assert episode.successes is not None
        # The achieved goal of FetchPush is the object's position, observation[3:6].
        np.testing.assert_allclose(episode.frames[:, 28:], episode.frames[:, 3:6], atol=1e-6)
        # The reward after step t belongs to the state t+1 and its goals.
        distance = np.linalg.norm(episode.frames[1:, 28:] - episode.frames[1:, 25:28], axis=1)
        np.testing.assert_array_equal(episode.rewards, np.where(distance > 0.05, -1.0, 0.0))
    assert not np.allclose(first.frames[0, 25:28], second.frames[0, 25:28])


def test_a_split_beyond_the_observation_is_refused() -> None:
    """Entries after the observation are goals and the action, not the surrounding state."""
    config = TACConfig().environment("FetchPush-v4")
    config.agent_indices, config.surrounding_indices = (0, 1, 2), (3, 25)
    with pytest.raises(ValueError, match="surrounding_indices must be < 25, the size of the obs"):
        TrajectoryEnvRunner(config=config, worker_index=0, num_workers=0)


def test_every_episode_has_a_new_goal_fixed_by_the_seed() -> None:
    def goals(seed: int, evaluation: bool) -> np.ndarray:
        made = runner(seed=seed, evaluation=evaluation)
        episodes = made.sample(num_episodes=5) + made.sample(num_episodes=3)
        return np.stack([episode.frames[0, 25:28] for episode in episodes])

    ours = goals(0, evaluation=False)
    assert len(np.unique(ours, axis=0)) == 8
    np.testing.assert_array_equal(ours, goals(0, evaluation=False))
    for other in (goals(1, evaluation=False), goals(0, evaluation=True)):
        assert len(np.unique(np.concatenate([ours, other]), axis=0)) == 16


def test_music_u_sees_no_goals_in_training_but_real_ones_in_evaluation() -> None:
    training, evaluating = runner(goals="zero"), runner(goals="zero", evaluation=True)
    assert all((e.frames[:, 25:28] == 0).all() for e in training.sample())
    assert all((e.frames[:, 25:28] != 0).any() for e in evaluating.sample())


class Seen(RLlibCallback):  # type: ignore[misc]
    """Counts calls, logs a metric, and keeps the episodes."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []
        self.made = 0
        self.samples: list[Any] = []

    def on_environment_created(self, *, env: Any, env_context: Any, **kwargs: Any) -> None:
        assert env_context.vector_index == self.made
        self.made += 1

    def on_episode_created(self, *, env_index: int, episode: Any, **kwargs: Any) -> None:
        self.calls.append(("created", env_index))
        assert len(episode) == 0

    def on_episode_start(self, *, env_index: int, episode: Any, **kwargs: Any) -> None:
        self.calls.append(("start", env_index))
        episode.custom_data["left"] = episode.get_observations(0)[0]

    def on_episode_step(
        self, *, env_index: int, episode: Any, env: Any, env_runner: Any, rl_module: Any, **_: Any
    ) -> None:
        self.calls.append(("step", env_index))
        assert episode.get_observations(-1)[0] == env.left
        assert env is env_runner.envs[env_index]
        assert rl_module is env_runner.module
        action = episode.get_actions(-1)
        scaled = episode.get_extra_model_outputs("actions_for_env", -1)
        np.testing.assert_allclose(scaled, [2 * action[0] - 1, 10 * action[1] + 20], rtol=1e-5)

    def on_episode_end(
        self, *, env_index: int, episode: Any, metrics_logger: Any, **kwargs: Any
    ) -> None:
        self.calls.append(("end", env_index))
        assert episode.is_done
        metrics_logger.log_value("from_a_callback", episode.get_return(), reduce="sum")

    def on_sample_end(self, *, samples: list[Any], **kwargs: Any) -> None:
        self.samples += samples


def test_rllibs_callbacks_of_episodes_are_called() -> None:
    ended: list[bool] = []
    callbacks = {
        "callbacks_class": Seen,
        "on_episode_end": lambda episode, **_: ended.append(episode.is_terminated),
    }
    limit: dict[str, Any] = {"max_episode_steps": 20}
    watched, plain = runner(Countdown, callbacks=callbacks, **limit), runner(Countdown, **limit)
    (seen,) = watched._callbacks._objects
    assert isinstance(seen, Seen)
    episodes = watched.sample()
    for mine, theirs in zip(episodes, plain.sample(), strict=True):
        np.testing.assert_array_equal(mine.frames, theirs.frames)
        np.testing.assert_array_equal(mine.actions, theirs.actions)
    assert seen.made == 2
    for index, episode in enumerate(episodes):
        named = [name for name, at in seen.calls if at == index]
        assert named == ["created", "start", *["step"] * len(episode), "end"]
    assert ended == [True, True]
    lengths = {len(episode) for episode in episodes}
    assert {len(sample) for sample in seen.samples} == lengths
    assert {sample.custom_data["left"] for sample in seen.samples} == lengths
    for sample in seen.samples:
        assert any(np.array_equal(sample.get_actions(), e.actions) for e in episodes)
    assert float(watched.get_metrics()["from_a_callback"]) == sum(map(len, episodes))


def test_an_episode_that_tac_ends_is_truncated_in_callbacks() -> None:
    ended = []
    runner(
        "FetchReach-v4",
        max_episode_steps=7,
        callbacks={"on_episode_end": lambda episode, **_: ended.append(episode)},
    ).sample(num_episodes=1)
    (episode,) = ended
    assert (len(episode), episode.is_truncated, episode.is_terminated) == (7, True, False)
    assert set(episode.get_observations(-1)) == {"observation", "achieved_goal", "desired_goal"}
    assert "is_success" in episode.get_infos(-1)


@pytest.mark.parametrize("behaviour", ["policy", {"kind": "colored_noise", "random_share": 0.3}])
def test_a_restored_runner_plays_the_same_episodes(behaviour: Any) -> None:
    one, other = (runner(behaviour=behaviour) for _ in range(2))
    one.sample()
    other.set_state(one.get_state())
    for ours, theirs in zip(one.sample(), other.sample(), strict=True):
        np.testing.assert_array_equal(ours.frames, theirs.frames)
        np.testing.assert_array_equal(ours.actions, theirs.actions)


def test_parts_of_a_runner_s_state_leave_other_runners_their_episodes() -> None:
    """RLlib sends parts of the training runner's state to evaluation runners."""
    training, evaluation = (
        runner(Countdown, max_episode_steps=6, evaluation=here) for here in (False, True)
    )
    evaluation.sample()
    before = evaluation.get_state()
    evaluation.set_state(training.get_state(components=["rl_module", "env_to_module_connector"]))
    after = evaluation.get_state()
    for name in ("episodes_started", "rng"):
        assert after[name] == before[name]


def test_a_step_without_the_declared_success_key_has_no_success() -> None:
    made = runner(SaysSuccessAtTheEnd, num_envs=3, max_episode_steps=6, missing=False)
    episodes = made.sample(num_episodes=40)
    assert {episode.terminated for episode in episodes} == {True, False}
    for episode in episodes:
        assert episode.successes is not None
        assert episode.successes.tolist() == [False] * (len(episode) - 1) + [episode.terminated]


def test_terminated_episodes_of_different_lengths_and_foreign_action_bounds() -> None:
    made = runner(Countdown, num_envs=3, max_episode_steps=6)
    episodes = made.sample(num_episodes=40)
    assert len(episodes) == 40
    assert {len(episode) for episode in episodes} == {2, 3, 4, 5, 6}
    for episode in episodes:
        started = int(episode.frames[0, 0])
        assert len(episode) == min(started, 6)
        assert episode.terminated == (started <= 6)  # longer ones are truncated, not terminated
        assert (np.abs(episode.actions) <= 1).all()
        assert episode.successes is None
    seen = np.concatenate([env.seen for env in made.envs if isinstance(env, Countdown)])
    assert (seen >= Countdown.action_space.low).all()
    assert (seen <= Countdown.action_space.high).all()
    lowest, highest = seen.min(0), seen.max(0)
    assert (
        highest - lowest > 0.5 * (Countdown.action_space.high - Countdown.action_space.low)
    ).all()


def test_sample_plays_the_given_number_of_steps_or_episodes() -> None:
    made = runner(Countdown, num_envs=2, max_episode_steps=10)
    assert len(made.sample(num_episodes=5)) == 5
    assert sum(map(len, made.sample(num_timesteps=30))) >= 30
    assert len(made.sample()) == 2


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"policy": "deterministic", "alpha": 0.0, "bootstrap": "critics", "behaviour": NOISE},
        {"normalise_observations": False, "log_std_form": "tanh"},
    ],
)
def test_the_runner_acts_as_its_module(settings: dict[str, Any]) -> None:
    made = runner(Countdown, num_envs=2, max_episode_steps=10, **settings)
    rng = np.random.default_rng(0)
    module = made.module
    if settings.get("normalise_observations", True):
        assert isinstance(module.normaliser, RunningNormaliser)
        module.normaliser.update(torch.from_numpy(rng.normal(3.0, 9.0, (50, 2))))
    inputs = rng.normal(3.0, 99.0, (30, 2)).astype(np.float32)
    noise = rng.standard_normal((30, *Countdown.action_space.shape), dtype=np.float32)
    rows, drawn = torch.from_numpy(inputs), torch.from_numpy(noise)
    actor = module.actor()
    np.testing.assert_allclose(actor(inputs, noise), module.act(rows, drawn), atol=1e-5)
    np.testing.assert_allclose(actor(inputs, None), module.act(rows), atol=1e-5)


def test_noise_of_the_original_music() -> None:
    made = runner(Countdown, num_envs=8, max_episode_steps=10, behaviour=NOISE)
    inputs = np.zeros((6000, 2), np.float32)
    actor = made.module.actor()
    actions = made._act(actor, inputs, explore=True, random_actions=False)
    mean = made._act(actor, inputs[:1], explore=False, random_actions=False)
    far = np.abs(actions - mean).max(1) > 5 * 0.05
    # A uniform action is that close with a probability of at most 0.25^2.
    assert 0.25 < far.mean() < 0.32
    assert (actions - mean)[~far].std() == pytest.approx(0.05, abs=0.01)
    assert (np.abs(actions) <= 1).all()


def test_wide_random_actions_are_mostly_near_a_bound() -> None:
    made = runner(Countdown, num_envs=100, max_episode_steps=9, random_actions="wide")
    actions = np.concatenate([each.actions for each in made.sample(random_actions=True)])
    # P(|3 z| > artanh 0.9) = 0.62; uniform actions: 0.1.
    assert 0.55 < (np.abs(actions) > 0.9).mean() < 0.7
    assert abs((actions > 0).mean() - 0.5) < 0.1


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("steps", [49, 50])
def test_colored_noise_is_standard_normal_with_the_given_spectrum(
    exponent: float, steps: int
) -> None:
    noise = colored_noise(np.random.default_rng(0), exponent, (steps, 4_000, 2))
    np.testing.assert_allclose(noise.std((1, 2)), 1.0, atol=0.06)  # at every step
    power = (np.abs(np.fft.rfft(noise, axis=0)) ** 2).mean((1, 2))[1:25]
    slope = np.polyfit(np.log(np.arange(1, 25)), np.log(power), 1)[0]
    assert slope == pytest.approx(-exponent, abs=0.05)


def test_episodes_with_colored_noise_are_samples_of_the_policy_with_random_actions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A policy with smooth noise acts smoothly, except for its random actions."""
    behaviour = {"kind": "colored_noise", "exponent": 2.0, "random_share": 0.2}
    made = runner(Countdown, num_envs=500, max_episode_steps=9, behaviour=behaviour)
    monkeypatch.setattr(made.module, "actor", lambda: lambda _, noise: np.clip(noise / 9, -1, 1))
    ends = np.concatenate([np.diff(one.actions[:, 0]) for one in made.sample()])
    sudden = np.abs(ends) > 0.25
    # A step is sudden unless both of its actions are smooth, or a random one is close by chance.
    assert 0.2 < sudden.mean() < 1 - 0.8**2


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (gym.spaces.Discrete(3), "bounded one-dimensional Box of one or more floats, got Discrete"),
        (gym.spaces.Box(-np.inf, np.inf, (2,)), "must be a bounded one-dimensional Box"),
        # A policy's actions between -1 and 1 would all be truncated to 0.
        (gym.spaces.Box(-1, 1, (2,), np.int32), "of one or more floats, got Box"),
    ],
)
def test_unusable_action_spaces_are_named(space: Any, message: str) -> None:
    class Odd(Countdown):
        action_space = space

    with pytest.raises(ValueError, match=message):
        runner(Odd, max_episode_steps=5)


def test_unusable_observations_and_missing_time_limit_are_named() -> None:
    class Picture(Countdown):
        observation_space = gym.spaces.Box(0, 255, (8, 8, 3))

    with pytest.raises(ValueError, match="must be a one-dimensional Box, or a Dict"):
        runner(Picture, max_episode_steps=5)
    with pytest.raises(ValueError, match=r"max_episode_steps must be set: the environment has no"):
        runner(Countdown)


@pytest.mark.parametrize("bad", [np.nan, -np.inf, 1e30])
def test_a_bad_number_is_named_with_its_environment_episode_and_step(bad: float) -> None:
    class Spoilt(Countdown):
        """The first step of the second sub-environment's second episode contains it."""

        def __init__(self, config: Any = None) -> None:
            super().__init__(config)
            self.episodes = -10 * (config.vector_index == 0)

        def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
            self.episodes += 1
            return super().reset(**arguments)

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            observation, *rest = super().step(action)
            observation[1] = bad if self.episodes == 2 else 0.0
            return observation, *rest

    made = runner(Spoilt, num_envs=2, max_episode_steps=6)
    made.sample()
    with pytest.raises(BadNumberError) as caught:
        made.sample()
    assert re.match(
        r"Spoilt, sub-environment 1, training episode 4 \(reset with seed \d+\), step 1: "
        rf"observation\[1\] is {re.escape(f'{bad:g}')}, ",
        str(caught.value),
    )


def test_a_non_finite_action_stops_before_the_environment() -> None:
    made = runner(Countdown, num_envs=2, max_episode_steps=6)
    made.module.state_dict()["policy.2.bias"][0] = float("nan")
    with pytest.raises(BadNumberError, match=r"step 0: the policy's action\[0\] is nan, it must"):
        made.sample()
    assert not any(env.seen for env in made.envs if isinstance(env, Countdown))


def test_episodes_without_the_success_key_count_if_others_have_it() -> None:
    class Lucky(Countdown):
        """Reports success, in one of three episodes only."""

        episodes = 0

        def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
            self.episodes += 1
            return super().reset(**arguments)

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            *rest, _ = super().step(action)
            return *rest, {"is_success": True} if self.episodes % 3 == 1 else {}

    made = runner(Lucky, num_envs=1, max_episode_steps=6)
    made.sample(num_episodes=6)
    assert made.get_metrics()[SUCCESS_LAST].peek() == pytest.approx(1 / 3)
    made.set_state(made.get_state())
    (episode,) = made.sample(num_episodes=1)
    assert episode.successes is not None
    made.sample(num_episodes=1)
    assert made.get_metrics()[SUCCESS_LAST].peek() == 0.5
