"""Mistakes that a sweep file can have without looking wrong; the schema agrees with the loader."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from music_rllib.config.document import SCHEMA
from music_rllib.config.load import load_config
from music_rllib.config.problems import ConfigError
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.plan import make_plan, remarks

SOUND: dict[str, Any] = {
    "name": "s",
    "tasks": ["FetchPush"],
    "stages": [{"name": "a", "variant": "tac"}],
}


def load(tmp_path: Path, **stage: Any) -> SweepConfig:
    document: dict[str, Any] = {"name": "s", "tasks": stage.pop("sweep_tasks", ["FetchPush"])}
    train: dict[str, Any] = {"name": "train", "variant": "tac"}
    document |= {"stages": [train | stage]}
    (tmp_path / "s.yaml").write_text(json.dumps(document))
    return load_config(tmp_path / "s.yaml")


@pytest.mark.parametrize("key", ["tac.alpha", "evaluation.interval", "replay.hindsight_k"])
def test_a_dotted_setting_in_a_stage_is_a_mistake(tmp_path: Path, key: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(tmp_path, **{key: 3})
    group, _, field = key.partition(".")
    hint = f"(did you mean '{group}: {{{field}: ...}}'?)"
    assert refusal.value.lines == (
        f"s.yaml:1: stages.train.{key} is not a known setting here {hint}",
    )


@pytest.mark.parametrize("key", ["seeds", "tasks"])
def test_seeds_in_a_grid_have_a_hint(tmp_path: Path, key: str) -> None:
    hint = rf"grid\.{key} is not a known setting \(did you mean '{key}'"
    with pytest.raises(ConfigError, match=hint):
        load(tmp_path, grid={key: [0, 1]})


def test_q_without_an_entropy_is_remarked(tmp_path: Path) -> None:
    ddpg: dict[str, Any] = {"policy": "deterministic", "alpha": 0, "bootstrap": "critics"}
    ddpg |= {"behaviour": {"kind": "gaussian_noise"}}
    grid = {"tac.entropic_index": [1.0, 2.0]}
    (line,) = remarks(make_plan(load(tmp_path, tac=ddpg, grid=grid)))
    assert line == "2 runs of a grid over q with alpha 0, where q has no effect on training"
    assert not remarks(make_plan(load(tmp_path, grid=grid)))
    assert not remarks(make_plan(load(tmp_path, tac=ddpg)))


def test_a_key_below_a_number_is_unknown(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"grid\.env_steps\.x is not a known setting"):
        load(tmp_path, env_steps=6000, grid={"env_steps.x": [3000]})


def test_shorter_episodes_need_less_capacity(tmp_path: Path) -> None:
    load(tmp_path, tac={"max_episode_steps": 10}, replay={"capacity": 40})
    with pytest.raises(ConfigError, match=r"\(4 x 10 steps\), got 39"):
        load(tmp_path, tac={"max_episode_steps": 10}, replay={"capacity": 39})


def test_a_mistake_in_tasks_is_one_mistake(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(tmp_path, sweep_tasks=["FetchPsh"], per_task={"FetchPush": {"env_steps": 5000}})
    assert len(refusal.value.lines) == 1


def test_the_schema_accepts_what_is_valid_and_knows_the_keys_of_defaults(tmp_path: Path) -> None:
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA.read_text()))
    extra: dict[str, Any]
    for extra in ({"defaults": None}, {"environments": None}, {"defaults": {"tac": None}}):
        (tmp_path / "s.yaml").write_text(json.dumps(SOUND | extra))
        load_config(tmp_path / "s.yaml")
        assert validator.is_valid(SOUND | extra), extra
    for typo in ({"env_stps": 5}, {"tac.alpha": 0.1}):
        assert not validator.is_valid(SOUND | {"defaults": typo}), typo


@pytest.mark.parametrize("swapped", [False, True])
def test_parts_of_a_mapping_count_in_any_order(tmp_path: Path, swapped: bool) -> None:
    (tmp_path / "s.yaml").write_text(json.dumps(SOUND))
    given = ["resources.num_cpus=3", "resources={cpus_per_run: 2}", "stages.a.tac.lr=2"]
    given.append("stages.a.tac={lr: 1}")
    config = load_config(tmp_path / "s.yaml", overrides=given[::-1] if swapped else given)
    assert (config.resources.num_cpus, config.resources.cpus_per_run) == (3, 2)
    assert config.stages[0].points[0].runs["FetchPush"].tac.lr == 2
