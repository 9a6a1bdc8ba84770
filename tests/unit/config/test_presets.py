"""Presets: their priority, their mistakes, and the validity of the shipped presets."""

from operator import attrgetter
from pathlib import Path

import pytest
import torch

from music_rllib.config.document import SHIPPED, shipped_presets
from music_rllib.config.load import load_config
from music_rllib.config.problems import ConfigError
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


def test_settings_of_the_sweep_replace_the_preset(tmp_path: Path) -> None:
    preset = "env_steps: 9000\nnum_envs: 3\ntac: {lr: 0.1, gamma: 0.5, tau: 0.25}\n"
    config = load_config(sweep(tmp_path, "mine", preset))
    pretrain, finetune = (stage.points[0].runs["FetchPush"] for stage in config.stages)
    assert (pretrain.env_steps, pretrain.num_envs) == (123456, 3)
    assert (pretrain.tac.lr, pretrain.tac.gamma, pretrain.tac.tau) == (0.0005, 0.9, 0.25)
    assert finetune.tac.gamma == 0.5


def test_hindsight_of_a_preset_does_not_reach_music_u(tmp_path: Path) -> None:
    config = load_config(sweep(tmp_path, "mine", "replay: {hindsight_k: 4}"))
    pretrain, finetune = (stage.points[0].runs["FetchPush"] for stage in config.stages)
    assert (pretrain.replay.hindsight_k, finetune.replay.hindsight_k) == (0, 4)
    path = tmp_path / "sweep.yaml"
    own = path.read_text().replace("tac: {gamma: 0.9}", "replay: {hindsight_k: 4}")
    path.write_text(own)
    with pytest.raises(ConfigError, match=r"pretrain.replay.hindsight_k has no effect with"):
        load_config(path)


@pytest.mark.parametrize("preset", sorted(path.stem for path in SHIPPED.glob("*.yaml")))
def test_every_shipped_preset_is_valid(preset: str, tmp_path: Path) -> None:
    config = load_config(sweep(tmp_path, preset))
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
def test_mistakes_of_a_preset_have_its_file_and_line(
    preset: str, content: str | None, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(sweep(tmp_path, preset, content))


def test_presets_are_listed_with_their_descriptions() -> None:
    small = "settings that learn the Fetch tasks on a 2-core machine, without their symmetries."
    assert shipped_presets()["small"] == small
    assert all(line.endswith(".") for line in shipped_presets().values())


def test_a_users_preset_replaces_a_shipped_preset(tmp_path: Path) -> None:
    path = sweep(tmp_path, "small")
    assert load_config(path).stages[0].points[0].runs["FetchPush"].num_envs == 4
    (tmp_path / "presets").mkdir()
    (tmp_path / "presets" / "small.yaml").write_text("num_envs: 7")
    assert load_config(path).stages[0].points[0].runs["FetchPush"].num_envs == 7


ORIGINAL_MUSIC = {
    "env_steps": 16 * 2 * 50 * 50 * 50,  # workers, rollouts, cycles, epochs, steps
    "evaluation.episodes": 320,
    "evaluation.interval": 80_000,
    "tac.hidden_sizes": (256, 256, 256),
    "tac.lr": 1e-3,
    "tac.gamma": 0.98,
    "tac.tau": 1 - 0.95,
    "tac.target_update_interval": 40,
    "tac.batch_size": 16 * 256,
    "tac.replay_ratio": 100_000 / 4_000_000,
    "music.batch_trajectories": 16 * 256,
    "music.hidden_size": 128,
    "music.lr": 1e-3,
    "music.reward_scale": 5000.0,
    "replay.hindsight_k": 0.0,
}
ORIGINALS = {
    "music-2021": {
        **ORIGINAL_MUSIC,
        "tac.policy": "deterministic",
        "tac.action_l2": 1.0,
        "tac.target_bounds": (-4 / (1 - 0.98), 4 / (1 - 0.98)),
        "tac.behaviour.std": 0.2,
        "tac.behaviour.random_share": 0.3,
        "tac.normaliser_epsilon": 0.01,
        "tac.observation_clip": 5.0,
        "music.shuffle": "random",
    },
    "paper": {
        **ORIGINAL_MUSIC,
        "tac.entropy_form": "joint",
        "tac.policy_critic": "min",
        "tac.bootstrap": "value",
        "tac.behaviour": "policy",
        "tac.alpha": 0.2,
        "tac.random_steps": 10_000,
        "music.shuffle": "independent",
    },
    "tac-2020": {
        "env_steps": 200 * 5000,
        "evaluation.episodes": 10,
        "tac.hidden_sizes": (400, 300),
        "tac.lr": 1e-3,
        "tac.batch_size": 100,
        "tac.gamma": 0.99,
        "tac.tau": 0.005,
        "tac.alpha": 0.2,
        "tac.entropy_form": "per_dimension",
        "tac.policy_critic": "first",
        "tac.replay_ratio": 1.0,
        "tac.random_steps": 10_000,
        "tac.log_std_form": "tanh",
        "tac.log_std_bounds": (-20.0, 2.0),
        "tac.normalise_observations": False,
        "replay.capacity": 1_000_000,
    },
}
"""The numbers of the papers and of their authors' code (docs/algorithms.md)."""


@pytest.mark.parametrize("preset", ORIGINALS)
def test_presets_have_the_numbers_of_the_originals(preset: str, tmp_path: Path) -> None:
    path = sweep(tmp_path, preset)
    path.write_text(
        path.read_text().partition("defaults")[0] + "stages: [{name: u, variant: music-u}]"
    )
    run = load_config(path).stages[0].points[0].runs["FetchPush"]
    for setting, number in ORIGINALS[preset].items():
        found = attrgetter(setting)(run)
        assert found == (pytest.approx(number) if isinstance(number, float | tuple) else number)


SWEEPS = sorted((Path(__file__).parents[3] / "tune_configs").rglob("*.yaml"))


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_every_shipped_sweep_is_valid(path: Path) -> None:
    assert load_config(path).stages


def test_music_2021_learns_from_the_intrinsic_reward_of_music_r(tmp_path: Path) -> None:
    """Targets are iterated to their limit if every step pays -1, and if every step pays -2."""
    finetune = load_config(sweep(tmp_path, "music-2021")).stages[1].points[0].runs["FetchPush"].tac
    values = torch.zeros(2, dtype=torch.float64)
    for _ in range(3000):
        values = critic_target(
            torch.tensor([-1.0, -2.0]), torch.ones(2), values, 0.98, finetune.target_bounds
        )
    assert values.tolist() == pytest.approx([-50.0, -100.0], rel=1e-5)


def test_the_entropy_terms_in_the_paper_preset_are_right() -> None:
    text = (SHIPPED / "paper.yaml").read_text()
    widths = torch.full((4,), 0.1, dtype=torch.float64)
    terms = [0.2 * float(joint_entropy(gaussian_entropy(widths, q), q)) for q in (1.0, 1.5, 2.0)]
    assert ", ".join(f"{term:.1f}" for term in terms[:2]) + f" and {terms[2]:.1f}" in text
