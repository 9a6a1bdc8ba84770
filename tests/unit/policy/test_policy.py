"""Policies of runs: the same actions as the trained networks, and nothing is executed."""

import dataclasses
import json
import pickle
import shutil
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from music_rllib.config.run_settings import RunSettings
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task
from music_rllib.policy import PolicyError, PolicyNetwork, find_policy, load_policy, policy
from music_rllib.policy.network import PolicyFileError
from music_rllib.policy.rollout import open_task, play
from music_rllib.store.handoff import Spaces, write_handoff
from music_rllib.store.sealed import SealedFolders
from music_rllib.store.storage import open_storage
from music_rllib.tac.networks import Perceptron, RunningNormaliser

REACH = BUILT_IN_TASKS["FetchReach"]
KEY, OTHER = "0123456789abcdef0123", "0123ffffffffffffffff"
INPUTS, ACTIONS, CLIP = 13, 4, 1.5
SPACES = Spaces(observation_size=10, goal_size=3, action_low=(-1.0,) * 4, action_high=(1.0,) * 4)


def _run(**tac: Any) -> RunSettings:
    settings = {"hidden_sizes": [8, 6], "observation_clip": CLIP, **tac}
    return RunSettings.model_validate({"task": REACH, "variant": "tac", "seed": 3, "tac": settings})


class Trained:
    """Networks of a run, and a folder as the run leaves it."""

    def __init__(self, run: RunSettings) -> None:
        torch.manual_seed(0)
        self.deterministic = run.tac.policy == "deterministic"
        outputs = ACTIONS if self.deterministic else 2 * ACTIONS
        layer_norm = run.tac.layer_norm == "all"
        self.policy = Perceptron(INPUTS, run.tac.hidden_sizes, outputs, layer_norm=layer_norm)
        self.normaliser = RunningNormaliser(INPUTS, epsilon=0.01, clip=CLIP)
        self.normaliser.update(torch.randn(50, INPUTS) * 3 + 1)
        self.run = run

    def act(self, inputs: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        states = torch.from_numpy(inputs)
        if self.run.tac.normalise_observations:
            states = self.normaliser(states)
        with torch.no_grad():
            return torch.tanh(self.policy(states)[..., :ACTIONS]).numpy()

    def write(self, folder: Path) -> Path:
        modules = {
            name: {key: tensor.numpy() for key, tensor in module.state_dict().items()}
            for name, module in (("policy", self.policy), ("normaliser", self.normaliser))
        }
        if not self.run.tac.normalise_observations:
            del modules["normaliser"]
        write_handoff(folder / "handoff", modules, self.run.handoff_info(KEY, 500, SPACES))
        (folder / "run.json").write_text(self.run.model_dump_json())
        return folder

    def publish(self, storage: Path, key: str = KEY) -> None:
        with SealedFolders(open_storage(f"{storage}/nodes")).sealing(key, {}) as folder:
            self.write(folder)


@pytest.fixture
def observations() -> np.ndarray[Any, Any]:
    return np.random.default_rng(1).normal(size=(7, INPUTS)).astype(np.float32) * 4


@pytest.mark.parametrize(
    "tac",
    [
        {},
        {"normalise_observations": False},
        {"policy": "deterministic", "bootstrap": "critics"},
        {"log_std_form": "tanh", "log_std_bounds": [-5.0, 2.0]},
        {"layer_norm": "all"},
        {"layer_norm": "critics"},
    ],
    ids=[
        "usual",
        "without normaliser",
        "deterministic",
        "scaled widths",
        "layer norm",
        "layer norm in critics only",
    ],
)
def test_acts_like_the_networks(
    tmp_path: Path, observations: np.ndarray[Any, Any], tac: dict[str, Any]
) -> None:
    if "policy" in tac:
        tac = tac | {"alpha": 0.0, "behaviour": {"kind": "gaussian_noise"}}
    trained = Trained(_run(**tac))
    policy = load_policy(trained.write(tmp_path))
    expected = trained.act(observations)
    np.testing.assert_allclose(policy.act(observations), expected, atol=2e-6)
    np.testing.assert_allclose(policy.act(observations[0]), expected[0], atol=2e-6)
    goals = {"observation": observations[:, :10], "desired_goal": observations[:, 10:]}
    np.testing.assert_array_equal(policy.act(goals), policy.act(observations))
    alone = policy.act({name: rows[2] for name, rows in goals.items()} | {"achieved_goal": None})
    assert alone.shape == (ACTIONS,)
    assert alone.dtype == np.float32
    np.testing.assert_allclose(alone, expected[2], atol=2e-6)


def test_a_policy_describes_its_run(tmp_path: Path) -> None:
    policy = load_policy(Trained(_run(max_episode_steps=20)).write(tmp_path))
    assert (policy.task, policy.seed, policy.variant) == (REACH, 3, "tac")
    assert (policy.node_key, policy.env_steps, policy.max_episode_steps) == (KEY, 500, 20)
    assert (policy.observation_size, policy.goal_size, policy.input_size) == (10, 3, 13)
    assert policy.action_size == ACTIONS


def test_a_handoff_alone_acts_as_its_run(
    tmp_path: Path, observations: np.ndarray[Any, Any]
) -> None:
    trained = Trained(_run(max_episode_steps=20))
    policy = load_policy(trained.write(tmp_path) / "handoff")
    assert policy.max_episode_steps == 20
    np.testing.assert_allclose(policy.act(observations), trained.act(observations), atol=2e-6)


@pytest.mark.parametrize("layer_norm", ["none", "all"])
def test_one_file_holds_all_of_it(
    tmp_path: Path, observations: np.ndarray[Any, Any], layer_norm: str
) -> None:
    policy = load_policy(Trained(_run(layer_norm=layer_norm)).write(tmp_path / "node"))
    (tmp_path / "packed.safetensors").write_bytes(policy.to_bytes())
    again = load_policy(tmp_path / "packed.safetensors")
    np.testing.assert_array_equal(again.act(observations), policy.act(observations))
    assert (again.task, again.env_steps) == (policy.task, policy.env_steps)
    assert again.max_episode_steps == policy.max_episode_steps


def test_scales_to_the_environments_bounds() -> None:
    eye = np.eye(2, dtype=np.float32)
    network = PolicyNetwork(
        weights=(eye,),
        biases=(np.zeros(2, np.float32),),
        mean=np.zeros(2, np.float32),
        inverse_std=np.ones(2, np.float32),
        clip=100.0,
        low=np.array([-2.0, 0.0], np.float32),
        high=np.array([2.0, 10.0], np.float32),
        goal_size=0,
    )
    # tanh(0) is the middle, tanh(+-100) the bounds.
    np.testing.assert_allclose(network.act([0.0, 0.0]), [0.0, 5.0])
    np.testing.assert_allclose(network.act({"observation": [100.0, -100.0]}), [2.0, 0.0])
    # Between such bounds every action would be the highest one.
    huge = np.full(2, np.finfo(np.float32).max)
    with pytest.raises(ValueError, match=r"actions must be within \+-1e\+15, got a bound of 3\.4"):
        dataclasses.replace(network, low=-huge, high=huge)


@pytest.mark.parametrize(
    "observation, complaint",
    [
        ({"observation": np.zeros(10)}, "desired_goal"),
        (
            {"observation": np.zeros(9), "desired_goal": np.zeros(3)},
            r"\[10\].*\(9,\)",
        ),
        ({"observation": np.zeros((2, 10)), "desired_goal": np.zeros(3)}, "one size"),
        (np.zeros(12), "side by side"),
        (np.zeros((1, 1, 13)), "shape"),
        (np.full(13, np.nan), "finite"),
        ("far away", "numbers"),
    ],
)
def test_invalid_observations_are_refused(tmp_path: Path, observation: Any, complaint: str) -> None:
    policy = load_policy(Trained(_run()).write(tmp_path))
    with pytest.raises(ValueError, match=complaint):
        policy.act(observation)


def test_damage_and_pickles_are_refused(tmp_path: Path) -> None:
    ran = tmp_path / "ran"

    class Malice:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (ran,)

    folder = Trained(_run()).write(tmp_path / "node")
    weights = folder / "handoff" / "policy.safetensors"
    weights.write_bytes(pickle.dumps(Malice()))
    with pytest.raises(PolicyError, match=r"policy\.safetensors must have"):
        load_policy(folder)
    with pytest.raises(PolicyError, match="must be a policy"):
        load_policy(weights)
    assert not ran.exists()


def test_a_file_with_other_content_is_refused(tmp_path: Path) -> None:
    handoff = Trained(_run()).write(tmp_path) / "handoff" / "policy.safetensors"
    with pytest.raises(PolicyFileError, match="header"):
        PolicyNetwork.from_file(handoff)
    with pytest.raises(PolicyError, match="the folder does not exist"):
        load_policy(tmp_path / "nowhere")


def test_a_published_node_is_verified(tmp_path: Path) -> None:
    Trained(_run()).publish(tmp_path)
    node = tmp_path / "nodes" / KEY
    assert load_policy(node).node_key == KEY
    assert load_policy(node.as_uri()).node_key == KEY
    (tmp_path / "latest").symlink_to(node)
    assert load_policy(tmp_path / "latest").node_key == KEY
    manifest = json.loads((node / "handoff" / "handoff.json").read_text())
    manifest["info"]["observation_clip"] = 0.1
    (node / "handoff" / "handoff.json").write_text(json.dumps(manifest))
    with pytest.raises(PolicyError, match=r"handoff\.json must have"):
        load_policy(node)


def test_is_found_by_key_label_and_place(tmp_path: Path) -> None:
    trained, storage = Trained(_run()), str(tmp_path)
    for key in (KEY, OTHER):
        trained.publish(tmp_path, key)
    with SealedFolders(open_storage(f"{storage}/work/77aa")).sealing("000000000400-x", {}) as new:
        trained.write(new)
    (tmp_path / "first").mkdir()
    nodes = [{"key": key, "label": f"run/seed={i}"} for i, key in enumerate((KEY, OTHER))]
    (tmp_path / "first" / "plan.json").write_text(json.dumps({"nodes": nodes}))
    place = f"{storage}/nodes/{KEY}"
    assert find_policy(KEY, storage) == find_policy("012345", storage) == place
    assert find_policy("run/seed=0", storage) == find_policy(place, storage) == place
    assert find_policy("77aa", storage) == f"{storage}/work/77aa/000000000400-x"
    assert load_policy(find_policy("77aa", storage)).env_steps == 500
    with pytest.raises(PolicyError, match=r"it matches run/seed=0 .*, run/seed=1 "):
        find_policy("0123", storage)
    with pytest.raises(PolicyError, match="finished there: run/seed=0, run/seed=1"):
        find_policy("run/seed=2", storage)
    shutil.rmtree(tmp_path / "nodes")
    with pytest.raises(PolicyError, match="no run is finished there"):
        find_policy("nothing", storage)


def test_is_found_by_a_label_that_is_too_long_for_a_file(tmp_path: Path) -> None:
    Trained(_run()).publish(tmp_path)
    (tmp_path / "first").mkdir()
    label = f"run/{'x' * 300}/seed=0"
    plan = {"nodes": [{"key": KEY, "label": label}]}
    (tmp_path / "first" / "plan.json").write_text(json.dumps(plan))
    assert find_policy(label, str(tmp_path)) == f"{tmp_path}/nodes/{KEY}"


def test_a_storage_keeps_its_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Trained(_run()).publish(tmp_path)
    monkeypatch.setattr(policy, "open_storage", lambda _: open_storage(str(tmp_path)))
    found = find_policy(KEY, "s3://bucket/x/?endpoint_override=127.0.0.1:9")
    assert found == f"s3://bucket/x/nodes/{KEY}?endpoint_override=127.0.0.1:9"


def test_a_run_that_sweeps_share_is_found_by_the_label_of_each(tmp_path: Path) -> None:
    Trained(_run()).publish(tmp_path)
    for sweep in ("first", "second"):
        (tmp_path / sweep).mkdir()
        nodes = [{"key": KEY, "label": f"{sweep}/seed=0"}]
        (tmp_path / sweep / "plan.json").write_text(json.dumps({"nodes": nodes}))
    place = f"{tmp_path}/nodes/{KEY}"
    for sweep in ("first", "second"):
        assert find_policy(f"{sweep}/seed=0", str(tmp_path)) == place
    (tmp_path / "first" / "plan.json").write_text("[]")
    with pytest.warns(UserWarning, match=r"first/plan\.json is damaged"):
        assert find_policy("second/seed=0", str(tmp_path)) == place


def test_a_folder_of_several_tasks_names_its_sub_folders(tmp_path: Path) -> None:
    """Like the output of `best` for a sweep with several tasks."""
    for task in ("FetchReach", "Other"):
        (tmp_path / task).mkdir()
        Trained(_run()).write(tmp_path / task)
    (tmp_path / "figures").mkdir()
    with pytest.raises(PolicyError) as error:
        load_policy(tmp_path)
    first, second = tmp_path / "FetchReach", tmp_path / "Other"
    assert str(error.value) == f"{tmp_path} must hold one policy: use {first} or {second}"
    assert load_policy(first).task == REACH


def test_a_damaged_manifest_is_not_taken_for_a_folder_of_several(tmp_path: Path) -> None:
    Trained(_run()).write(tmp_path)
    Trained(_run()).write(tmp_path / "FetchReach")
    (tmp_path / "handoff" / "handoff.json").write_text("{}")
    with pytest.raises(PolicyError, match=r"handoff.json must be a handoff manifest"):
        load_policy(tmp_path)


class Cells(gym.Env[Any, Any]):
    """Two cells that go from 1 to 0."""

    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, kind: Any) -> None:
        self.kind: Any = np.dtype(kind)
        self.observation_space = spaces.Box(0, 1, (2,), self.kind)

    def reset(self, **options: Any) -> Any:
        return np.ones(2, self.kind), {}

    def step(self, action: Any) -> Any:
        return np.zeros(2, self.kind), 0.0, False, False, {}


@pytest.mark.parametrize("kind", ["float32", "uint8", "bool"])
def test_the_displacement_of_any_type_of_observation(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_cells = EnvSpec("Cells-v0", cast("Any", Cells), max_episode_steps=2)
    monkeypatch.setitem(gym.registry, "Cells-v0", of_cells)
    task = Task(
        name="C",
        env_id="Cells-v0",
        horizon=2,
        success_key=None,
        env_kwargs={"kind": kind},
        agent_indices=(0,),
        surrounding_indices=(1,),
    )
    about = {
        "task": task.model_dump(mode="json"),
        "variant": "tac",
        "seed": 0,
        "node_key": "0" * 20,
        "env_steps": 1,
        "max_episode_steps": 2,
    }
    one, two = np.ones(1, np.float32), np.ones(2, np.float32)
    network = PolicyNetwork(
        weights=(np.zeros((1, 2), np.float32),),
        biases=(0 * one,),
        mean=0 * two,
        inverse_std=two,
        clip=5.0,
        low=-one,
        high=one,
        goal_size=0,
        about=about,
    )
    (tmp_path / "p").write_bytes(network.to_bytes())
    policy = load_policy(tmp_path / "p", [task])
    assert next(play(policy, open_task(policy), 1, 0)).object_displacement == 1.0
