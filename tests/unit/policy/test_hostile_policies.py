"""Policies from strangers: nothing in them is imported, executed, or read without a limit."""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from music_rllib.config.load import declared_tasks
from music_rllib.envs.make import known_environment
from music_rllib.envs.tasks import BUILT_IN_TASKS, Task
from music_rllib.policy import Policy, PolicyError, load_policy
from music_rllib.policy.rollout import open_task, play
from music_rllib.program import main as sweep_main
from music_rllib.store.handoff import HandoffError
from music_rllib.store.handoff import read_handoff as read_handoff_of
from music_rllib.store.sealed import SealedFolders
from music_rllib.store.storage import DamagedError, open_storage
from tests.hostile_files import INPUTS, PENDULUM, STRANGE, seal_policy, write_policy


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
    """A module in the current folder; returns whether it has been imported."""
    ran = tmp_path / "ran"
    (tmp_path / "evil_module.py").write_text(f"import pathlib; pathlib.Path({str(ran)!r}).touch()")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return ran.exists


EVIL = Task(name="Evil", env_id="evil_module:Evil-v0", horizon=20, success_key=None)


def packed(policy: Policy, file: Path) -> Path:
    file.write_bytes(policy.to_bytes())
    return file


def test_a_policy_acts_and_imports_nothing(tmp_path: Path, evil: Callable[[], bool]) -> None:
    handoff = write_policy(tmp_path / "stranger", EVIL)
    file = packed(load_policy(handoff), tmp_path / "packed.safetensors")
    for place in (handoff, file, seal_policy(tmp_path / "sealed", EVIL)):
        policy = load_policy(place)
        assert policy.act(np.zeros(INPUTS)).shape == (1,)
        assert policy.environment is None
        with pytest.raises(PolicyError, match=r'file names "evil_module:Evil-v0".*--env'):
            open_task(policy)
    assert not evil()


def test_evaluate_imports_nothing_that_a_file_names(
    tmp_path: Path, evil: Callable[[], bool], capsys: pytest.CaptureFixture[str]
) -> None:
    place = str(write_policy(tmp_path / "stranger", EVIL))
    assert sweep_main(["evaluate", place, "--episodes", "1"]) == 2
    assert "evil_module:Evil-v0" in capsys.readouterr().err
    assert not evil()
    # With the user's consent it is imported, and found to register no such environment.
    assert sweep_main(["evaluate", place, "--episodes", "1", "--env", EVIL.env_id]) == 2
    assert "Evil" in capsys.readouterr().err
    assert evil()


def test_the_same_policy_of_a_known_environment_is_played(tmp_path: Path) -> None:
    """Pendulum is Gymnasium's; an environment of a sweep's YAML is the user's own."""
    policy = load_policy(write_policy(tmp_path / "known", PENDULUM))
    open_task(policy).close()
    longer = PENDULUM.model_copy(update={"env_kwargs": {"g": 9.0}})
    place = write_policy(tmp_path / "longer", longer)
    with pytest.raises(PolicyError, match=r'with \{"g": 9\.0\}'):
        open_task(load_policy(place))
    sweep = tmp_path / "mine.yaml"
    sweep.write_text(
        "environments:\n  Mine: {env_id: Pendulum-v1, horizon: 20, env_kwargs: {g: 9.0}}\n"
    )
    env = open_task(load_policy(place, declared_tasks(sweep)))
    assert env.unwrapped.g == 9.0  # type: ignore[attr-defined]
    env.close()
    with pytest.raises(PolicyError, match="takes arguments"):
        load_policy(place, "Pendulum-v1")
    with pytest.raises(PolicyError, match="must fit the policy"):
        open_task(load_policy(write_policy(tmp_path / "reach", BUILT_IN_TASKS["FetchReach"])))


def test_what_an_environment_does_in_an_episode_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = load_policy(write_policy(tmp_path / "known", PENDULUM))
    env = open_task(policy)

    def unstable(action: object) -> None:
        raise RuntimeError("simulator unstable")

    with monkeypatch.context() as patch:
        patch.setattr(env.unwrapped, "step", unstable)
        with pytest.raises(
            PolicyError, match=r"Pendulum.*step 1: RuntimeError: simulator unstable"
        ):
            next(play(policy, env, 1, seed=0))
    monkeypatch.setattr(env.unwrapped, "_get_obs", lambda: np.full(3, np.nan, np.float32))
    with pytest.raises(PolicyError, match="finite"):
        next(play(policy, env, 1, seed=0))
    env.close()


def test_a_password_is_not_in_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://alice:s3cr3tpw@127.0.0.1:9")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with pytest.raises(PolicyError) as raised:
        load_policy("models:/m-0123456789")
    assert "s3cr3tpw" not in "".join(traceback.format_exception(raised.value))


@pytest.mark.parametrize(
    "env_id, kwargs, known",
    [
        ("FetchPush-v4", {}, True),
        ("HandManipulateBlockRotateZ-v1", {}, True),
        ("HalfCheetah-v5", {}, True),
        ("HalfCheetah-v5", {"xml_file": "/tmp/evil.xml"}, False),
        ("HalfCheetah-v5", {"frame_skip": 10**9}, False),
        ("FetchPush-v4", {"model_path": "/tmp/evil.xml"}, False),
        ("gymnasium:HalfCheetah-v5", {}, False),
        ("os:FetchPush-v4", {}, False),
        ("GymV26Environment-v0", {"env_id": "evil_module:X"}, False),
        ("Nothing-v0", {}, False),
    ],
)
def test_which_environments_a_file_may_name(
    env_id: str, kwargs: dict[str, object], known: bool
) -> None:
    task = Task.model_validate({"name": "T", "env_id": env_id, "horizon": 1, "env_kwargs": kwargs})
    assert (known_environment(task) is not None) == known
    assert known_environment(task, [task]) == (env_id, kwargs)


# Not regular files --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", STRANGE)
@pytest.mark.parametrize("file", ["handoff.json", "policy.safetensors"])
def test_only_regular_files_are_read(tmp_path: Path, kind: str, file: str) -> None:
    """A link to an endless device would fill a disk, a FIFO would block."""
    node = seal_policy(tmp_path, PENDULUM)
    (node / "handoff" / file).unlink()
    STRANGE[kind](node / "handoff" / file)
    with pytest.raises(PolicyError, match=r"must (have|be readable)"):
        load_policy(node)
    # A handoff without its run is not copied first.
    (node / "manifest.json").unlink()
    with pytest.raises(PolicyError, match=r"must (have|hold|be)"):
        load_policy(node)


@pytest.mark.parametrize("kind", STRANGE)
def test_only_a_regular_file_is_a_manifest(tmp_path: Path, kind: str) -> None:
    node = seal_policy(tmp_path, PENDULUM)
    (node / "manifest.json").unlink()
    STRANGE[kind](node / "manifest.json")
    with pytest.raises(DamagedError, match=r"manifest\.json must be"):
        SealedFolders(open_storage(str(tmp_path))).manifest("node")


@pytest.mark.parametrize("kind", STRANGE)
def test_a_checkpoint_s_other_files_are_not_even_looked_at(tmp_path: Path, kind: str) -> None:
    storage = SealedFolders(open_storage(str(tmp_path)))
    with storage.sealing("node", {}) as folder:
        write_policy(folder, PENDULUM)
        (folder / "state.safetensors").write_bytes(b"much")
    file = tmp_path / "node" / "state.safetensors"
    file.unlink()
    STRANGE[kind](file)
    assert load_policy(tmp_path / "node").seed == 0
    with pytest.raises(DamagedError, match="state"):
        storage.fetch("node", tmp_path / "copy")
    with pytest.raises(DamagedError, match="state"):
        storage.read("node", "state.safetensors")


def test_the_size_in_a_manifest_is_the_limit(tmp_path: Path) -> None:
    node = seal_policy(tmp_path, PENDULUM)
    weights = node / "handoff" / "policy.safetensors"
    with weights.open("ab") as file:
        file.truncate(1 << 40)
    manifest = json.loads((node / "manifest.json").read_text())
    manifest["files"]["handoff/policy.safetensors"]["bytes"] = 1 << 40
    (node / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(PolicyError, match=rf"at most {1 << 30} bytes of weights, it has 10995"):
        load_policy(node)
    (node / "manifest.json").unlink()
    with pytest.raises(HandoffError, match=r"it has 10995.* bytes, more than 312"):
        read_handoff_of(node, ["policy"], PENDULUM)


def test_a_header_is_measured_before_it_is_parsed(tmp_path: Path) -> None:
    file = tmp_path / "policy.safetensors"
    file.write_bytes((90 << 20).to_bytes(8, "little") + b"{" + b" " * (90 << 20))
    with pytest.raises(PolicyError, match="header must have at most"):
        load_policy(file)
