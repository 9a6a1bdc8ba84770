"""Presets: laid below everything that a sweep says itself, and every shipped one is sound."""

from pathlib import Path
from typing import Any

import pytest
import torch

from music_rllib.config.document import SHIPPED, shipped_presets
from music_rllib.config.load import load_sweep, warnings_of
from music_rllib.config.problems import ConfigError
from music_rllib.config.yaml_file import read_yaml
from music_rllib.functional.actor_critic import critic_target
from tests.unit.functional.entropies import gaussian_entropy, joint_entropy

SWEEP = """
name: one
tasks: [FetchPush]
preset: {preset}
defaults: {{env_steps: 123456, tac: {{lr: 0.0005}}}}
stages:
  - {{name: pretrain, variant: music-u, tac: {{gamma: 0.9}}}}
  - {{name: finetune, variant: music-r, init_from: pretrain}}
"""


def sweep(folder: Path, preset: str, content: str | None = None) -> Path:
    if content is not None:
        (folder / "presets").mkdir(exist_ok=True)
        (folder / "presets" / "mine.yaml").write_text(content)
    path = folder / "sweep.yaml"
    path.write_text(SWEEP.format(preset=preset))
    return path


def test_the_sweeps_own_settings_lie_above_the_preset(tmp_path: Path) -> None:
    preset = "env_steps: 9000\nnum_envs: 3\ntac: {lr: 0.1, gamma: 0.5, tau: 0.25}\n"
    config = load_sweep(sweep(tmp_path, "mine", preset))
    pretrain, finetune = (stage.points[0].runs["FetchPush"] for stage in config.stages)
    assert (pretrain.env_steps, pretrain.num_envs) == (123456, 3)
    assert (pretrain.tac.lr, pretrain.tac.gamma, pretrain.tac.tau) == (0.0005, 0.9, 0.25)
    assert finetune.tac.gamma == 0.5


def test_hindsight_of_a_preset_does_not_reach_music_u(tmp_path: Path) -> None:
    config = load_sweep(sweep(tmp_path, "mine", "replay: {hindsight_k: 4}"))
    pretrain, finetune = (stage.points[0].runs["FetchPush"] for stage in config.stages)
    assert (pretrain.replay.hindsight_k, finetune.replay.hindsight_k) == (0, 4)
    path = tmp_path / "sweep.yaml"
    own = path.read_text().replace("tac: {gamma: 0.9}", "replay: {hindsight_k: 4}")
    path.write_text(own)
    with pytest.raises(ConfigError, match=r"pretrain.replay.hindsight_k has no effect with"):
        load_sweep(path)


@pytest.mark.parametrize("preset", sorted(path.stem for path in SHIPPED.glob("*.yaml")))
def test_every_shipped_preset_makes_a_sound_sweep(preset: str, tmp_path: Path) -> None:
    config = load_sweep(sweep(tmp_path, preset))
    assert all(point.runs for stage in config.stages for point in stage.points)


@pytest.mark.parametrize(
    ("preset", "content", "message"),
    [
        (
            "mime",
            "env_steps: 1000",
            r"sweep.yaml:4: preset must be one of mine, music-2021, .*did you mean .mine",
        ),
        ("3", "env_steps: 1000", r"sweep.yaml:4: preset must be a preset's name or a file, got 3"),
        ("other.yaml", None, r"other.yaml: must be an existing file"),
        ("mine", "tac: {entropic_index: -1}", r"mine.yaml:1: tac.entropic_index must be > 0, got"),
        ("mine", "env_steps: 1000\nstages: []", r"mine.yaml:2: stages is not a known setting"),
    ],
)
def test_mistakes_are_named_where_they_are(
    preset: str, content: str | None, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        load_sweep(sweep(tmp_path, preset, content))


def test_presets_are_listed_with_what_they_are() -> None:
    assert (
        shipped_presets()["small"]
        == "the settings that learned FetchPush in the fewest steps on a 2-core machine."
    )
    assert all(line.endswith(".") for line in shipped_presets().values())


def test_a_preset_of_ones_own_comes_before_the_packages(tmp_path: Path) -> None:
    path = sweep(tmp_path, "small")
    assert load_sweep(path).stages[0].points[0].runs["FetchPush"].num_envs == 4
    (tmp_path / "presets").mkdir()
    (tmp_path / "presets" / "small.yaml").write_text("num_envs: 7")
    assert load_sweep(path).stages[0].points[0].runs["FetchPush"].num_envs == 7


SWEEPS = sorted((Path(__file__).parents[3] / "tune_configs").rglob("*.yaml"))


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_every_shipped_sweep_is_sound(path: Path) -> None:
    assert load_sweep(path).stages


def test_music_2021_learns_from_the_intrinsic_reward_of_music_r(tmp_path: Path) -> None:
    """Targets are iterated to where they end if every step pays -1, and if every step pays -2."""
    finetune = load_sweep(sweep(tmp_path, "music-2021")).stages[1].points[0].runs["FetchPush"].tac
    values = torch.zeros(2, dtype=torch.float64)
    for _ in range(3000):
        values = critic_target(
            torch.tensor([-1.0, -2.0]), torch.ones(2), values, 0.98, finetune.target_bounds
        )
    assert values.tolist() == pytest.approx([-50.0, -100.0], rel=1e-5)


def test_no_shipped_bounds_cut_off_what_can_be_reached(tmp_path: Path) -> None:
    for preset in sorted(path.stem for path in SHIPPED.glob("*.yaml")):
        config = load_sweep(sweep(tmp_path, preset))
        assert warnings_of(config) == []
    for path in SWEEPS:
        assert warnings_of(load_sweep(path)) == []


CLAIMED: dict[str, dict[str, Any]] = {
    "music-2021": {
        "env_steps": 16 * 2 * 50 * 50 * 50,
        "num_envs": 16,
        "evaluation": {"interval": 16 * 2 * 50 * 50, "episodes": 10 * 2 * 16},
        "tac": {
            "policy": "deterministic",
            "bootstrap": "critics",
            "alpha": 0.0,
            "action_l2": 1.0,
            "target_bounds": [-200.0, 200.0],
            "hidden_sizes": [256, 256, 256],
            "lr": 1e-3,
            "gamma": 0.98,
            "tau": 0.05,
            "target_update_interval": 40,
            "batch_size": 16 * 256,
            "replay_ratio": 40 / (16 * 2 * 50),
            "random_steps": 0,
            "behaviour": {"kind": "gaussian_noise", "std": 0.2, "random_share": 0.3},
            "normaliser_epsilon": 0.01,
            "observation_clip": 5.0,
        },
        "music": {
            "shuffle": "random",
            "reward_scale": 5000.0,
            "hidden_size": 128,
            "lr": 1e-3,
            "batch_trajectories": 16 * 256,
        },
        "replay": {"capacity": 4_000_000, "hindsight_k": 0},
    },
    "paper": {
        "env_steps": 4_000_000,
        "num_envs": 16,
        "evaluation": {"interval": 80_000, "episodes": 320},
        "tac": {
            "alpha": 0.2,
            "entropy_form": "joint",
            "policy_critic": "min",
            "hidden_sizes": [256, 256, 256],
            "lr": 1e-3,
            "gamma": 0.98,
            "tau": 0.05,
            "target_update_interval": 40,
            "batch_size": 16 * 256,
            "replay_ratio": 100_000 / 4_000_000,
            "random_steps": 10_000,
            "behaviour": "policy",
        },
        "music": {"batch_trajectories": 16 * 256},
        "replay": {"capacity": 4_000_000, "hindsight_k": 0},
    },
    "tac-2020": {
        "env_steps": 200 * 5000,
        "num_envs": 1,
        "evaluation": {"interval": 5000, "episodes": 10},
        "tac": {
            "alpha": 0.2,
            "entropy_form": "per_dimension",
            "policy_critic": "first",
            "hidden_sizes": [400, 300],
            "lr": 1e-3,
            "gamma": 0.99,
            "tau": 1 - 0.995,
            "batch_size": 100,
            "replay_ratio": 1.0,
            "random_steps": 10_000,
            "warmup_steps": 0,
            "log_std_form": "tanh",
            "log_std_bounds": [-20.0, 2.0],
            "normalise_observations": False,
            "behaviour": "policy",
        },
        "replay": {"capacity": 1_000_000, "hindsight_k": 0},
    },
}
"""The originals' numbers, as their code has them; nothing else may stand in a preset of them."""


@pytest.mark.parametrize("preset", CLAIMED)
def test_presets_have_the_originals_numbers(preset: str) -> None:
    def flat(values: dict[str, Any]) -> dict[str, Any]:
        inner = {k: v for k, v in values.items() if not isinstance(v, dict)}
        for key in values.keys() - inner.keys():
            inner |= {f"{key}.{name}": value for name, value in flat(values[key]).items()}
        return inner

    found, expected = flat(read_yaml(SHIPPED / f"{preset}.yaml").data), flat(CLAIMED[preset])
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        close = pytest.approx(value) if isinstance(value, float) else value
        assert found[name] == close, name


def test_what_papers_preset_says_its_entropy_weighs() -> None:
    text = (SHIPPED / "paper.yaml").read_text()
    widths = torch.full((4,), 0.1, dtype=torch.float64)
    terms = [0.2 * float(joint_entropy(gaussian_entropy(widths, q), q)) for q in (1.0, 1.5, 2.0)]
    assert ", ".join(f"{term:.1f}" for term in terms[:2]) + f" and {terms[2]:.1f}" in text
