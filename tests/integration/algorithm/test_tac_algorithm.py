"""TAC as an RLlib algorithm: reproducible, exactly resumable, without dead settings."""

import itertools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from ray import tune
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule
from ray.tune.registry import ENV_CREATOR, _global_registry
from torch import nn

from music_rllib import TACConfig, names
from music_rllib.config.run_settings import ReplaySettings
from music_rllib.config.tac_settings import TACSettings
from music_rllib.envs.make import make_env
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.envs.values import BadNumberError
from music_rllib.intrinsic.music import HELD_OUT_STEPS
from music_rllib.intrinsic.settings import IntrinsicSettings, MusicSettings
from music_rllib.replay.trajectories import Trajectory
from music_rllib.tac.algorithm import TAC
from music_rllib.tac.rl_module import TACModule
from tests.unit.test_snippets import ROOT, blocks

pytestmark = pytest.mark.usefixtures("local_ray")

HER: dict[str, Any] = {"replay.hindsight_k": 4.0}


class OfflineCallbacks(RLlibCallback):  # type: ignore[misc]
    def on_evaluate_offline_end(self, **kwargs: Any) -> None:
        pass


class OwnNetworks(TACModule):
    """A policy and a value network with other layers, of a given width.

    Both have dropout, which draws from PyTorch's own generator.
    """

    def setup(self) -> None:
        super().setup()
        width = self.model_config["width"]
        for name, outputs in (("policy", 2 * self.action_size), ("value", 1)):
            first, last = nn.Linear(self.input_size, width), nn.Linear(width, outputs)
            setattr(self, name, nn.Sequential(first, nn.Dropout(0.1), nn.Tanh(), last))
        self.make_target_networks()


SMALL: dict[str, Any] = {
    "hidden_sizes": (32, 32),
    "batch_size": 32,
    "random_steps": 100,
    "replay_ratio": 0.2,
}


def test_the_program_in_the_readme_trains(capsys: pytest.CaptureFixture[str]) -> None:
    (program,) = blocks(ROOT / "README.md", "python")
    variables: dict[str, Any] = {}
    exec(program, variables)
    assert variables["algo"].env_steps > 0
    assert "num_env_steps_sampled_lifetime" in capsys.readouterr().out
    variables["algo"].stop()


def build(
    task: str = "FetchReach-v4",
    *,
    music: dict[str, Any] | None = None,
    where: dict[str, int] | None = None,
    **settings: Any,
) -> TAC:
    replay = {
        name.removeprefix("replay."): settings.pop(name)
        for name in list(settings)
        if name.startswith("replay.")
    }
    config = TACConfig().environment(task)
    for name in [name for name in settings if name.startswith("intrinsic.")]:
        config.intrinsic(**{name.removeprefix("intrinsic."): settings.pop(name)})
    config.env_runners(
        num_envs_per_env_runner=2, num_env_runners=(where or {}).get("num_env_runners", 0)
    )
    learners = {"num_learners": 0, "num_gpus_per_learner": 0}
    config.learners(
        **{name: (where or {}).get(name, default) for name, default in learners.items()}
    )
    config.reporting(min_sample_timesteps_per_iteration=1)
    config.training(**{**SMALL, "total_env_steps": 1_000, **settings})
    symmetries = BUILT_IN_TASKS["FetchReach"].symmetries.model_dump()
    config.replay(**{"capacity": 10_000, "task_symmetries": symmetries, **replay})
    if music is not None:
        config.music(agent_indices=range(3), surrounding_indices=range(3, 6), **music)
    config.evaluation(evaluation_interval=10**9, evaluation_duration=2)
    config.debugging(seed=0)
    algo: TAC = config.build_algo()
    return algo


def fingerprint(algo: TAC, iterations: int) -> list[dict[str, float]]:
    """All metrics of a run by iteration, and the sums of its weights."""
    rows = []
    for _ in range(iterations):
        result = algo.train()
        learner = result.get("learners", {}).get("default_policy", {})
        rows.append(
            {k: float(v) for k, v in learner.items() if "/" in k}
            | {"return": float(result["env_runners"]["episode_return_mean"])}
        )
    evaluation = algo.evaluate()["env_runners"]
    rows.append({"evaluation": float(evaluation["episode_return_mean"])})
    return [*rows, weight_sums(algo)]


def weight_sums(algo: TAC) -> dict[str, float]:
    parts = algo.get_network_weights()
    return {
        f"{part}.{name}": float(np.sum(array, dtype=np.float64))
        for part, arrays in parts.items()
        for name, array in arrays.items()
    }


MUSIC_U = {"estimator": "trained", "mi_reward_weight": 1.0, "task_reward": False, "goals": "zero"}
MUSIC_R = {"estimator": "frozen", "mi_reward_weight": 0.5}


@pytest.mark.parametrize("music", [None, MUSIC_U])
def test_same_seed_gives_bit_identical_metrics_and_weights(music: dict[str, Any] | None) -> None:
    settings = HER if music is None else {}
    first = fingerprint(build(music=music, **settings), 3)
    second = fingerprint(build(music=music, **settings), 3)
    assert first == second
    assert first[-3]["loss/critics"] > 0


@pytest.mark.parametrize(
    ("settings", "updates"),
    [
        ({}, [0, 20, 40]),
        ({"warmup_steps": 0}, [20, 40, 60]),
        ({"warmup_steps": 250}, [0, 0, 10]),
    ],
)
def test_warmup_steps_delay_or_advance_the_first_update(
    settings: dict[str, Any], updates: list[int]
) -> None:
    algo = build(**settings)
    random, done = [], []
    sample = algo.env_runner.sample

    def watched(*, random_actions: bool) -> Any:
        random.append(random_actions)
        return sample(random_actions=random_actions)

    algo.env_runner.sample = watched
    for _ in updates:
        algo.train()
        done.append(algo.grad_updates)
    assert (random, done) == ([True, False, False], updates)


RAMP = {"schedule": "linear", "start": 1.0, "end": 2.0, "begin": 0.0}


@pytest.mark.parametrize(
    "settings",
    [{"alpha": 0.1, "entropic_index": RAMP}, {"alpha": {"learned": True}}],
    ids=["q scheduled", "alpha learned"],
)
def test_a_restored_checkpoint_continues_with_the_same_numbers(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    unbroken = build(music=MUSIC_U, **settings)
    fingerprint(unbroken, 2)
    unbroken.save_to_path(tmp_path / "checkpoint")
    expected = fingerprint(unbroken, 2)
    resumed = build(music=MUSIC_U, **settings)
    resumed.restore_from_path(tmp_path / "checkpoint")
    assert fingerprint(resumed, 2) == expected
    # Also in a process that has trained further: RLlib's own runners would keep newer weights.
    unbroken.restore_from_path(tmp_path / "checkpoint")
    assert fingerprint(unbroken, 2) == expected


DDPG: dict[str, Any] = {
    "policy": "deterministic",
    "bootstrap": "critics",
    "alpha": 0.0,
    "behaviour": {"kind": "gaussian_noise"},
    "target_bounds": (-200.0, 0.0),
}
ANNEALED = {"schedule": "linear", "start": 0.4, "end": 1.0}
PER: dict[str, Any] = {"replay.priority": "td_error", "replay.importance_exponent": ANNEALED}
RND = {"intrinsic.reward": "rnd"}

# A changed value for every setting, and other settings that both compared runs need.
CHANGES: dict[str, tuple[Any, dict[str, Any]]] = {
    "entropic_index": (1.5, {}),
    "alpha": (0.5, {}),
    "entropy_form": ("joint", {}),
    "policy": ("deterministic", DDPG | {"policy": "stochastic"}),
    "bootstrap": ("critics", {}),
    "policy_critic": ("first", {}),
    "critics": (3, {}),
    "target_critics": (2, {"critics": 3}),
    "quantiles": (5, {"bootstrap": "critics"}),
    "dropped_quantiles": (1, {"bootstrap": "critics", "quantiles": 5}),
    "policy_delay": (2, {}),
    "hidden_sizes": ((32, 16), {}),
    "layer_norm": ("critics", {}),
    "log_std_bounds": ((-1.0, -0.5), {}),
    "log_std_form": ("tanh", {}),
    "lr": (3e-4, {}),
    "gamma": (0.9, {}),
    "tau": (0.5, {}),
    "target_update_interval": (3, {}),
    "target_bounds": ((-1.0, 0.0), {}),
    "batch_size": (48, {}),
    "replay_ratio": (0.5, {}),
    "random_steps": (200, {}),
    "random_actions": ("wide", {}),
    "warmup_steps": (0, {}),
    "normalise_observations": (False, {}),
    "observation_clip": (0.5, {}),
    "normaliser_epsilon": (0.3, {}),
    "behaviour": ({"kind": "gaussian_noise"}, {}),
    "action_l2": (1.0, {}),
    "max_episode_steps": (20, {}),
    "replay.capacity": (200, {}),
    "replay.hindsight_k": (1.0, {}),
    "replay.hindsight_episodes": ("moved", {}),
    "replay.hindsight_goals": ("final", {}),
    "replay.n_steps": (3, {"music.estimator": "none", "music.mi_reward_weight": 0.0}),
    "replay.symmetries": (("mirror",), {}),
    "replay.priority": ("td_error", {}),
    "replay.priority_exponent": (1.0, PER),
    "replay.importance_exponent": (1.0, PER),
    "music.mi_reward_weight": (0.1, {}),
    "music.task_reward": (False, {}),
    "music.goals": ("zero", {"replay.hindsight_k": 0.0}),
    "music.reward_scale": (50.0, {}),
    "music.bound": ("infonce", {}),
    "music.shuffle": ("random", {}),
    "music.hidden_size": (16, {}),
    "music.lr": (1e-2, {}),
    "music.batch_trajectories": (8, {}),
    "music.prioritise_replay": (True, {}),
    "music.estimator": ("frozen", {}),
    "intrinsic.reward": ("random", {}),
    "intrinsic.weight": (0.3, RND),
    "intrinsic.lr": (1e-2, RND),
    "intrinsic.settings": ({"hidden": 16}, RND),
    "intrinsic.frozen": (True, RND),
}


def last_weights(settings: dict[str, Any]) -> dict[str, float]:
    """Sums of all weights after three iterations with HER and a trained estimator."""
    chosen: dict[str, Any] = {**HER, "entropic_index": 1.2, **settings}
    music: dict[str, Any] = {"estimator": "trained", "mi_reward_weight": 1.0}
    for name in [name for name in chosen if name.startswith("music.")]:
        music[name.removeprefix("music.")] = chosen.pop(name)
    algo = build(music=music, **chosen)
    for _ in range(3):
        algo.train()
    return weight_sums(algo)


@pytest.fixture(scope="module")
def bases() -> dict[str, dict[str, float]]:
    """Results of the unchanged runs, by their settings."""
    return {}


def test_every_setting_is_listed() -> None:
    fields = set(TACSettings.model_fields)
    fields |= {f"music.{name}" for name in MusicSettings.model_fields}
    fields |= {f"replay.{name}" for name in ReplaySettings.model_fields}
    fields |= {f"intrinsic.{name}" for name in IntrinsicSettings.model_fields}
    assert fields == set(CHANGES)


@pytest.mark.parametrize("setting", CHANGES)
def test_no_setting_is_dead(setting: str, bases: dict[str, dict[str, float]]) -> None:
    value, base = CHANGES[setting]
    if repr(base) not in bases:
        bases[repr(base)] = last_weights(base)
    assert last_weights({**base, setting: value}) != bases[repr(base)]


NOISE_AND_STEPS: dict[str, Any] = {
    "behaviour": {"kind": "colored_noise", "random_share": 0.3},
    "replay.n_steps": 3,
    "replay.symmetries": ("mirror", "translate"),
}
REDQ: dict[str, Any] = {
    "bootstrap": "critics",
    "critics": 3,
    "target_critics": 2,
    "policy_critic": "mean",
    "policy_delay": 3,
    "quantiles": 5,
}


@pytest.mark.parametrize(
    "settings",
    [
        DDPG,
        {"bootstrap": "critics", "alpha": {"learned": True}},
        PER | NOISE_AND_STEPS,
        REDQ,
        {"intrinsic.reward": "e3b"},
    ],
    ids=[
        "ddpg",
        "sac",
        "per, colored noise, three steps, symmetries",
        "drawn quantile critics, delayed policy",
        "e3b",
    ],
)
def test_other_backbones_and_rewards_resume_exactly_too(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    unbroken = build(**HER, **settings)
    fingerprint(unbroken, 2)
    unbroken.save_to_path(tmp_path / "checkpoint")
    resumed = build(**HER, **settings)
    resumed.restore_from_path(tmp_path / "checkpoint")
    assert fingerprint(resumed, 1) == fingerprint(unbroken, 1)


def test_own_networks_act_learn_and_are_restored(tmp_path: Path) -> None:
    def own() -> TAC:
        config = TACConfig().environment("FetchReach-v4").training(**SMALL).debugging(seed=0)
        config.reporting(min_sample_timesteps_per_iteration=1)
        config.evaluation(evaluation_interval=10**9, evaluation_duration=2)
        spec = RLModuleSpec(module_class=OwnNetworks, model_config={"width": 12})
        algo: TAC = config.rl_module(rl_module_spec=spec).build_algo()
        return algo

    algo, resumed = own(), own()
    before = algo.get_network_weights()
    assert before["policy"]["0.weight"].shape == (12, 13)
    fingerprint(algo, 3)
    after = algo.get_network_weights()
    for network in ("policy", "critics", "value", "value_target"):
        assert any((after[network][n] != a).any() for n, a in before[network].items()), network
    inputs = np.ones((2, 13), np.float32)
    acted = algo.env_runner.module.actor()(inputs, None)
    module = algo.learner_group._learner.module["default_policy"]
    assert module.training, "dropout is for updates only"
    np.testing.assert_array_equal(acted, module.eval().act(torch.from_numpy(inputs)).numpy())
    module.train()
    algo.save_to_path(tmp_path / "checkpoint")
    expected = fingerprint(algo, 1)
    resumed.restore_from_path(tmp_path / "checkpoint")
    assert fingerprint(resumed, 1) == expected


def test_a_module_acts_in_unit_bounds_that_scale_to_those_of_pendulum() -> None:
    """`forward_inference` as docs/api.md describes it: [-1, 1] for the torques of [-2, 2]."""
    algo: TAC = TACConfig().environment("Pendulum-v1").training(hidden_sizes=[8]).build_algo()
    module, box = algo.env_runner.module, gym.spaces.Box(-2.0, 2.0, (1,))
    inputs = torch.linspace(-1.0, 1.0, 24).reshape(8, 3)
    for bias, torque in ((20.0, 2.0), (-20.0, -2.0)):
        with torch.no_grad():
            list(module.policy.parameters())[-1][0] = bias  # the mean before tanh
        for forward in (module.forward_inference, module.forward_exploration):
            action = forward({"obs": inputs})["actions"].numpy()
            np.testing.assert_allclose(action, np.sign(bias), atol=1e-3)
            scaled = box.low + (action + 1) / 2 * (box.high - box.low)
            np.testing.assert_array_equal(scaled, algo.env_runner._to_env(action))
            np.testing.assert_allclose(scaled, torque, atol=2e-3)


@pytest.mark.parametrize("settings", [HER, DDPG], ids=["tac", "ddpg"])
def test_target_networks_have_no_autograd_history(settings: dict[str, Any]) -> None:
    """Otherwise each update of the averages would stay in memory, half a kilobyte per tensor."""
    algo = build(**settings)
    fingerprint(algo, 2)
    learner = algo.learner_group._learner
    assert learner._targets
    assert all(target.is_leaf and not target.requires_grad for target in learner._targets)


def test_q_bias_equals_its_definition() -> None:
    """With critic values of 3 and a target value of -7, the bias is computed by hand."""
    algo = build(music=None, alpha=0.0, gamma=0.9)
    learner = algo.learner_group._learner
    module = learner.module["default_policy"]
    for parameter in module.parameters():
        parameter.data.zero_()
    module.critics.biases[-1].data.fill_(3.0)
    module.value_target[-1].bias.data.fill_(-7.0)
    learner.metrics.reduce()
    episodes = algo.env_runner.sample(random_actions=True)
    learner.diagnose(episodes, None)
    returns = [sum(r * 0.9**t for t, r in enumerate(e.rewards)) - 7 * 0.9**50 for e in episodes]
    logged = learner.metrics.peek(("default_policy", names.Q_BIAS))
    assert logged == pytest.approx(3.0 - np.mean(returns), rel=1e-5)


def test_remote_runners_and_learner_learn_and_resume_like_local_ones(tmp_path: Path) -> None:
    """A bad reward stops them too."""
    register_spoilt(530)
    algo = build("Spoilt", music=MUSIC_U, where={"num_env_runners": 1, "num_learners": 1})
    first = [algo.train() for _ in range(3)][-1]
    assert first["env_runners"]["num_env_steps_sampled_lifetime"] == 300
    assert np.isfinite(first["learners"]["default_policy"]["loss/critics"])
    assert algo.grad_updates == 40
    before = weight_sums(algo)
    algo.save_to_path(tmp_path / "checkpoint")
    assert algo.evaluate()["env_runners"]["episode_return_mean"] <= 0
    after = []
    for _ in range(2):
        algo.train()
        after.append((weight_sums(algo), algo.env_steps, algo.grad_updates))
        algo.restore_from_path(tmp_path / "checkpoint")
        assert weight_sums(algo) == before
    assert after[0] == after[1]
    assert after[0][0] != before
    assert after[0][1:] == (400, 60)
    check_that_a_bad_reward_stops(algo)


def register_uneven() -> None:
    """Register `Uneven`: FetchReach with episodes of 1 to 50 steps, depending on the seed."""

    def uneven(context: Any) -> gym.Env[Any, Any]:
        class Uneven(gym.Wrapper[Any, Any, Any, Any]):
            left = 0

            def reset(self, *, seed: Any = None, options: Any = None) -> Any:
                self.left = int(np.random.default_rng(seed).integers(1, 51))
                return self.env.reset(seed=seed, options=options)

            def step(self, action: Any) -> Any:
                observation, reward, _, truncated, info = self.env.step(action)
                self.left -= 1
                return observation, reward, self.left == 0, truncated, info

        return Uneven(make_env("FetchReach-v4"))

    tune.register_env("Uneven", uneven)


def test_hindsight_ends_transitions_of_a_maze_at_their_new_goal() -> None:
    maze = {"continuing_task": False, "max_episode_steps": 50}
    tune.register_env("Maze", lambda context: make_env("PointMaze_UMaze-v3", **maze))
    algo = build("Maze", **HER)
    algo.train()
    batch = algo.replay.sample_transitions(500)
    position, goal = np.split(batch.next_inputs[:, [0, 1, 4, 5]], 2, axis=1)
    reached = np.linalg.norm(position - goal, axis=1) <= 0.45
    assert 0.1 < reached.mean() < 0.9
    np.testing.assert_array_equal(batch.discounts == 0, reached)
    np.testing.assert_array_equal(batch.rewards == 1, reached)


def test_the_bound_on_fresh_episodes_is_taken_over_all_of_them(tmp_path: Path) -> None:
    register_uneven()
    algo, resumed = (build("Uneven", music=MUSIC_U) for _ in range(2))
    while algo.env_steps < 200:
        last = algo.train()
    steps = [int(n) for n in algo.replay.packed(0)["lengths"]]
    found = last["learners"]["default_policy"]
    assert found[HELD_OUT_STEPS] == sum(n for n in steps[-2:] if n > 1)
    assert len(set(steps)) > 3
    assert abs(found["mutual_information/held_out_bound"]) < 0.5
    # Measurements that are not yet reported are part of the state.
    learner = algo.learner_group._learner
    assert learner._music.metrics() == {}
    held = algo.replay.packed(0)
    ends = np.cumsum([0, *steps])
    for i, (begin, end) in enumerate(itertools.pairwise(ends)):
        columns = (held["actions"][begin:end], held["rewards"][begin:end], held["terminated"][i])
        learner.diagnose([Trajectory(held["frames"][begin + i : end + i + 1], *columns)], None)
    algo.save_to_path(tmp_path / "checkpoint")
    resumed.restore_from_path(tmp_path / "checkpoint")
    taken = learner._music.metrics()
    assert taken[HELD_OUT_STEPS] == sum(n for n in steps if n > 1)
    assert resumed.learner_group._learner._music.metrics() == taken
    assert fingerprint(resumed, 1) == fingerprint(algo, 1)


def register_spoilt(step: int) -> None:
    """Register `Spoilt`: FetchReach whose reward is NaN once, at the step of that number."""

    def spoilt(context: Any) -> gym.Env[Any, Any]:
        class Spoilt(gym.Wrapper[Any, Any, Any, Any]):
            steps = 0

            def step(self, action: Any) -> Any:
                observation, reward, *rest = self.env.step(action)
                self.steps += 1
                return observation, float("nan") if self.steps == step else reward, *rest

        return Spoilt(make_env("FetchReach-v4"))

    tune.register_env("Spoilt", spoilt)


def check_that_a_bad_reward_stops(algo: TAC) -> None:
    """Train until the bad reward, which must reach neither the replay nor the weights."""
    seen = []

    def train() -> None:
        for _ in range(10):
            seen.append((algo.replay.trajectories, weight_sums(algo)))
            algo.train()

    with pytest.raises(BadNumberError, match=r"^FetchReach-v4, sub-env.* step 30: reward is nan"):
        train()
    assert (algo.replay.trajectories, weight_sums(algo)) == seen[-1]
    assert np.isfinite(algo.replay.packed(0)["rewards"]).all()
    algo.stop()
    assert not Path(algo.logdir).exists()


def test_a_bad_reward_stops_training_and_never_reaches_the_replay() -> None:
    register_spoilt(130)
    check_that_a_bad_reward_stops(build("Spoilt"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"entropic_index": -1.0}, r"^entropic_index must be > 0, got -1$"),
        ({"alpha": -1}, r"^alpha must be >= 0, got -1$"),
        ({"alpha": {"learned": True, "lr": -1}}, r"^alpha\.lr must be > 0, got -1$"),
        ({"gamma": 1.0}, r"^gamma must be < 1, got 1.0$"),
        ({"lr": float("nan")}, r"^lr must be a finite number, got nan$"),
        ({"behaviour": "greedy"}, r"^behaviour must be 'policy', got \"greedy\""),
        ({"entropic_indx": 2.0}, r"unexpected keyword argument 'entropic_indx'"),
    ],
)
def test_a_bad_setting_is_refused(settings: dict[str, Any], message: str) -> None:
    # RLlib itself drops every setting of -1, and would use the default.
    with pytest.raises((ValueError, TypeError), match=message):
        TACConfig().environment("Pendulum-v1").training(**settings).build_algo()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda c: c.training(policy="deterministic"), "alpha must be 0 for policy: deterministic"),
        (lambda c: c.music(estimator="trained", mi_reward_weight=1.0), "set music.agent_indices"),
        (lambda c: c.music(agent_indices=[0, 1, 2], surrounding_indices=[2, 3]), r"overlap.*\[2\]"),
        (lambda c: c.music(agent_indices=[0]).music(surrounding_indices=range(2)), "overlap"),
        (lambda c: c.music(agent_indices=[1, 1], surrounding_indices=[2]), "must not repeat an"),
        (lambda c: c.music(agent_indices=[0, 1]), "surrounding_indices must be given too"),
        (lambda c: c.update_from_dict({"agent_indices": [0], "surrounding_indices": [0]}), "overl"),
        (lambda c: c.music(agent_indices=[-1], surrounding_indices=[2]), r"agent_indices.*got -1"),
        (lambda c: c.music(goals="zero").replay(hindsight_k=4.0), "hindsight_k must be 0 with"),
        (lambda c: c.learners(num_learners=2), "num_learners must be 0 or 1, got 2"),
        (lambda c: c.training(train_batch_size=4), "train_batch_size=4 has no.*batch_size="),
        (lambda c: c.training(train_batch_size_per_learner=4), r"set training\(batch_size="),
        (
            lambda c: c.training(num_epochs=5, minibatch_size=7),
            r"num_epochs=5(.|\n)*minibatch_s",
        ),
        (lambda c: c.training(learner_connector=print), "TAC runs no connectors: wrap"),
        (lambda c: c.env_runners(module_to_env_connector=print), "TAC runs no connectors: wrap"),
        (lambda c: c.env_runners(rollout_fragment_length=5), "one whole episode in each sub-env"),
        (lambda c: c.env_runners(gym_env_vectorize_mode="async"), "num_env_runners for processes"),
        (lambda c: c.environment(clip_rewards=True), "clip_rewards=True.*wrap the environment"),
        (lambda c: c.environment(normalize_actions=False), r"always scales actions from \[-1, 1\]"),
        (lambda c: c.rl_module(model_config={"fcnet_hiddens": [4]}), "hidden_sizes=.*TACModule"),
        (lambda c: c.fault_tolerance(restart_failed_sub_environments=True), "num_env_runners="),
        (lambda c: c.framework("tf2"), "framework must be 'torch', got 'tf2'"),
        (lambda c: c.multi_agent(policies={"a", "b"}), "TAC trains one policy"),
        (lambda c: c.learners(learner_class=TorchLearner), "subclass of TACLearner, got TorchLe"),
        (
            lambda c: c.rl_module(rl_module_spec=RLModuleSpec(module_class=TorchRLModule)),
            "must be a subclass of music_rllib.TACModule, got TorchRLModule",
        ),
        (lambda c: c.callbacks(OfflineCallbacks), "on_evaluate_offline_end is never called by TAC"),
        (
            lambda c: c.training(entropic_index={"schedule": "linear", "start": 1.0, "end": 2.0}),
            "a linear schedule needs the budget",
        ),
        (
            lambda c: c.training(
                entropic_index={"follows": "success_rate", "points": [[0, 1], [1, 2]]}
            ),
            "entropic_index.follows: success_rate needs evaluations",
        ),
        (lambda c: c.update_from_dict({"entropic_indx": 2.0}), "config: entropic_indx"),
        (lambda c: c.update_from_dict({"replay": {"capacity": 5}}), "config: replay .*prefix"),
        (lambda c: c.update_from_dict({"settings": 1}), "config: settings"),
        (lambda c: c.debugging(seed=-1), r"seed=\.\.\.\) must be >= 0, got -1"),
        (lambda c: c.training(total_env_steps=-5), "must be >= 1, got -5"),
        (lambda c: c.training(torch_threads=0), "must be >= 1, got 0"),
        (lambda c: c.fault_tolerance(ignore_env_runner_failures=True), "would be another run"),
    ],
)
def test_contradictory_settings_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(TACConfig().environment("Pendulum-v1")).validate()


def test_search_spaces_of_tune_stay_in_the_configuration() -> None:
    space = tune.choice([[0], [1]])
    config = TACConfig().music(agent_indices=space, surrounding_indices=tune.grid_search([[2]]))
    assert config.agent_indices is space
    assert config.surrounding_indices == {"grid_search": [[2]]}
    assert config.update_from_dict({"framework": "torch", "replay_capacity": 5}).replay_capacity


class Shifted(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> float:
        return 1_000.0


def test_a_name_that_is_registered_with_ray_is_the_users_environment() -> None:
    tune.register_env("Pendulum-v1", lambda _: Shifted(gym.make("Pendulum-v1")))
    try:
        algo = build("Pendulum-v1", random_steps=10_000)
        assert algo.train()["env_runners"]["episode_return_mean"] == 200_000.0
        algo.stop()
    finally:
        _global_registry.unregister(ENV_CREATOR, "Pendulum-v1")


class OfAClass(PendulumEnv):
    def __init__(self, config: Any) -> None:
        super().__init__()


def test_a_class_and_a_time_limit_without_a_registration_are_an_environment() -> None:
    config = TACConfig().environment(OfAClass).training(**SMALL, max_episode_steps=20)
    algo: TAC = config.reporting(min_sample_timesteps_per_iteration=1).build_algo()
    assert algo.train()["env_runners"]["episode_len_mean"] == 20
    algo.stop()
    tune.register_env("Limited", lambda c: gym.wrappers.TimeLimit(OfAClass(c), 30))
    algo = build("Limited")
    assert algo.train()["env_runners"]["episode_len_mean"] == 30
    algo.stop()


def test_delayed_updates_without_rllibs_skipping_of_nans() -> None:
    config = TACConfig().environment("Pendulum-v1").training(**SMALL, policy_delay=2)
    config.framework(torch_skip_nan_gradients=False).reporting(min_sample_timesteps_per_iteration=1)
    algo: TAC = config.build_algo()
    results = [algo.train() for _ in range(2)][-1]
    assert results["learners"]["__all_modules__"]["grad_updates"] == algo.grad_updates > 0
    algo.stop()


def test_a_checkpoint_is_restored_with_other_settings(tmp_path: Path) -> None:
    learned = build("Pendulum-v1", alpha={"learned": True, "lr": 1e-3})
    for _ in range(2):
        learned.train()
    learned.save_to_path(str(tmp_path))
    fixed = build(
        "Pendulum-v1",
        entropic_index={"follows": "shannon_entropy", "points": [[0, 1], [1, 2]]},
    )
    fixed.restore_from_path(str(tmp_path))
    before, after = (algo.learner_group._learner._adam["networks"] for algo in (learned, fixed))
    for one, other in zip(before.state.values(), after.state.values(), strict=True):
        assert torch.equal(one["exp_avg_sq"], other["exp_avg_sq"])
    assert len(fixed.learner_group._learner._module_optimizers["default_policy"]) == 1
    fixed.train()
    td_error: dict[str, Any] = {"replay.priority": "td_error"}
    prioritized = build("Pendulum-v1", **td_error)
    with pytest.raises(ValueError, match="priority must be that of the checkpoint"):
        prioritized.restore_from_path(str(tmp_path))
    for algo in (learned, fixed, prioritized):
        algo.stop()


def test_evaluation_takes_the_mean_action_unless_asked_otherwise() -> None:
    config = TACConfig().environment("Pendulum-v1").evaluation(evaluation_interval=1)
    assert config.get_evaluation_config_object().explore is False
    exploring = config.copy().evaluation(evaluation_config={"explore": True})
    assert exploring.get_evaluation_config_object().explore is True
    algo = TACConfig().environment("Pendulum-v1").build_algo()
    with pytest.raises(ValueError, match="set evaluation"):
        algo.evaluate()


def test_settings_are_validated_once_until_one_of_them_changes() -> None:
    config = TACConfig().environment("Pendulum-v1").training(entropic_index=1.5)
    config.validate()
    settings = config.settings
    assert config.settings is settings
    assert TACConfig.from_state(config.get_state()).settings is settings
    assert TACConfig().use(settings).settings is settings
    assert config.training(entropic_index=2.0).settings.tac.entropic_index == 2.0
