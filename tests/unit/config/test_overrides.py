"""`KEY=VALUE` arguments: precedence, places of changed values, and mistakes."""

import json
from pathlib import Path
from typing import Any

import pytest

from music_rllib.config.load import load_config
from music_rllib.config.problems import ConfigError
from music_rllib.config.run_settings import RunSettings
from music_rllib.config.schema import SweepConfig
from tests.sweep_files import loaded

SWEEP = """
name: mine
tasks: [FetchReach]
seeds: 2
defaults: {env_steps: 1e5, tac: {lr: 0.002, gamma: 0.9}}
stages:
  - name: first
    variant: tac
    env_steps: 3e4
    per_task: {FetchReach: {tac: {lr: 0.003}}}
  - name: second
    variant: tac
    tac: {alpha: {matched_width: 0.5, value: 0.1}}
    grid: {tac.entropic_index: [1, 1.5]}
"""


def load(folder: Path, *arguments: str, text: str = SWEEP) -> SweepConfig:
    return loaded(folder, text, overrides=arguments)


def mistake(folder: Path, *arguments: str, text: str = SWEEP) -> str:
    """The only mistake of a configuration."""
    with pytest.raises(ConfigError) as refusal:
        load(folder, *arguments, text=text)
    (line,) = refusal.value.lines
    return line


def runs(config: SweepConfig) -> list[RunSettings]:
    return [point.runs["FetchReach"] for stage in config.stages for point in stage.points]


def test_a_setting_holds_in_every_stage(tmp_path: Path) -> None:
    before = runs(load(tmp_path))
    assert {(run.env_steps, run.tac.lr) for run in before} == {(30_000, 0.003), (100_000, 0.002)}
    after = runs(load(tmp_path, "env_steps=1e6", "tac.lr=1e-4"))
    assert {(run.env_steps, run.tac.lr, run.tac.gamma) for run in after} == {(10**6, 1e-4, 0.9)}


def test_overrides_equal_an_edited_file(tmp_path: Path) -> None:
    config = load(tmp_path, "seeds=5", "stages.second.env_steps=7e4", "name=other")
    assert (config.seeds, config.name) == ((0, 1, 2, 3, 4), "other")
    path = tmp_path / "written.yaml"
    path.write_text(
        SWEEP.replace("seeds: 2", "seeds: [0, 1, 2, 3, 4]")
        .replace("name: mine", "name: other")
        .replace("tac: {alpha", "env_steps: 70000\n    tac: {alpha")
    )
    assert runs(config) == runs(load_config(path))
    # The files kept in the sweep's folder reproduce the sweep.
    kept = tmp_path / "config.json"
    kept.write_text(json.dumps(config.document))
    assert runs(load_config(kept)) == runs(config)
    assert load_config(kept).seeds == config.seeds


def test_values_inside_a_setting_and_a_grid(tmp_path: Path) -> None:
    config = load(
        tmp_path,
        "stages.second.tac.alpha.value=0.3",
        "stages.second.grid.tac.entropic_index=[1, 2, 3]",
    )
    first, *second = runs(config)
    assert first.tac.alpha == 0.2
    assert [run.tac.entropic_index for run in second] == [1, 2, 3]
    assert {run.tac.alpha.value for run in second} == {0.3}  # type: ignore[union-attr]


def test_a_setting_may_replace_a_grid_that_varied_it(tmp_path: Path) -> None:
    arguments = "tac.entropic_index=3", "stages.second.grid={}"
    for given in (arguments, arguments[::-1]):
        assert [run.tac.entropic_index for run in runs(load(tmp_path, *given))] == [3, 3]


def test_a_preset_of_the_command_line_is_below_the_file(tmp_path: Path) -> None:
    first = runs(load(tmp_path, "preset=small"))[0]
    assert (first.tac.tau, first.tac.gamma) == (0.05, 0.9)


def test_new_defaults_keep_the_preset_which_null_switches_off(tmp_path: Path) -> None:
    text = SWEEP.replace("seeds: 2", "preset: small")
    first = runs(load(tmp_path, "defaults={env_steps: 5e4, tac: {lr: 0.01}}", text=text))[1]
    # Of the preset, of the new defaults, and no longer of the file's.
    assert (first.tac.tau, first.tac.lr, first.tac.gamma) == (0.05, 0.01, 0.95)
    assert runs(load(tmp_path, "preset=null", text=text)) == runs(load(tmp_path))
    assert runs(load(tmp_path, text=SWEEP.replace("seeds: 2", "preset: null"))) == runs(
        load(tmp_path)
    )


def test_a_setting_of_one_stage_counts_in_any_order(tmp_path: Path) -> None:
    arguments = "stages.first.tac.lr=0.01", "tac.lr=0.02"
    for given in (arguments, arguments[::-1]):
        assert [run.tac.lr for run in runs(load(tmp_path, *given))] == [0.01, 0.02, 0.02]


def test_a_setting_of_one_stage_replaces_those_of_its_tasks(tmp_path: Path) -> None:
    first, second, _ = runs(load(tmp_path, "stages.first.tac.lr=0.01"))
    assert (first.tac.lr, second.tac.lr) == (0.01, 0.002)
    own = ("stages.first.per_task.FetchReach.tac.lr=0.02", "stages.first.tac.lr=0.01")
    assert runs(load(tmp_path, *own))[0].tac.lr == 0.02


SHARED = """
name: mine
tasks: [FetchReach]
stages:
  - {name: a, variant: tac, tac: &t {lr: 0.001}, grid: &g {tac.gamma: [0.9, 0.8]}}
  - {name: b, variant: tac, tac: *t, grid: *g}
  - {name: c, variant: tac, replay: &r {hindsight_k: 4}, per_task: {FetchReach: {replay: *r}}}
"""


def test_an_override_changes_an_anchored_value_in_one_stage(tmp_path: Path) -> None:
    changes = ("stages.a.tac.lr=0.01", "stages.a.grid.tac.gamma=[0.7, 0.6]")
    first, second, third, fourth, _ = runs(load(tmp_path, *changes, text=SHARED))
    assert [(run.tac.lr, run.tac.gamma) for run in (first, second)] == [(0.01, 0.7), (0.01, 0.6)]
    assert [(run.tac.lr, run.tac.gamma) for run in (third, fourth)] == [(0.001, 0.9), (0.001, 0.8)]


def test_names_of_tasks_may_have_dots(tmp_path: Path) -> None:
    text = """
name: s
tasks: [Lift, Lift-1.5kg]
environments:
  Lift: &lift {env_id: FetchPush-v4, horizon: 50}
  Lift-1.5kg: *lift
stages: [{name: a.b, variant: tac}]
"""
    own = "stages.a.b.per_task.Lift-1.5kg.tac.lr=0.5"
    config = load(tmp_path, own, "environments.Lift-1.5kg.horizon=20", text=text)
    first, second = config.stages[0].points[0].runs.values()
    assert (first.task.horizon, second.task.horizon) == (50, 20)
    assert (first.tac.lr, second.tac.lr) == (1e-3, 0.5)


@pytest.mark.parametrize("prefix", ["", "stages.first.", "stages.first.per_task.FetchReach."])
def test_a_group_replaces_only_its_fields(tmp_path: Path, prefix: str) -> None:
    before = runs(load(tmp_path))[0]
    after = runs(load(tmp_path, f"{prefix}tac={{tau: 0.2, gamma: 0.8}}"))[0]
    assert (after.tac.tau, after.tac.gamma, after.tac.lr) == (0.2, 0.8, before.tac.lr)
    interval = "stages.first.evaluation.interval=250"
    evaluation = runs(load(tmp_path, interval, "evaluation={episodes: 7}"))[0].evaluation
    assert (evaluation.interval, evaluation.episodes) == (250, 7)


GROUPED = """
name: mine
tasks: [FetchReach]
stages:
  - name: train
    variant: tac
    grid: {tac: [{entropic_index: 1, alpha: 0.1}, {entropic_index: 2, alpha: 0.2}]}
"""


def test_fields_that_a_grid_group_does_not_vary_can_be_overridden(tmp_path: Path) -> None:
    after = runs(load(tmp_path, "tac={gamma: 0.9}", text=GROUPED))
    assert [(run.tac.gamma, run.tac.alpha) for run in after] == [(0.9, 0.1), (0.9, 0.2)]
    searched = GROUPED.replace("grid: {tac: ", "search: {trials: 2, space: {tac: {choice: ")
    searched = searched.replace("]}\n", "]}}}\n")
    assert runs(load(tmp_path, "tac.gamma=0.9", text=searched))[0].tac.gamma == 0.9
    for text, place in ((GROUPED, "grid"), (searched, "search.space")):
        rule = f"tac.alpha must not be given where stages.train.{place}.tac varies it"
        assert mistake(tmp_path, "tac.alpha=0.3", text=text) == f"command line: {rule}"


TUNED = "tac: [{entropic_index: 1, alpha: 0.1}, {entropic_index: 2, alpha: 0.2}]"
TWICE: list[tuple[str, str]] = [
    (
        f"grid: {{{TUNED}, tac.alpha: [0.3, 0.4]}}",
        "tac must not hold a field that varies by itself",
    ),
    (f"grid: {{tac.alpha: [0.3, 0.4], {TUNED}}}", "itself too, got alpha"),
    (
        f"search: {{trials: 2, mode: compare, compare: {{{TUNED}}}, "
        "space: {tac.alpha: {float: [0.1, 1]}}}",
        "compare.tac must not vary what space.tac.alpha varies, got tac.alpha in both",
    ),
    (
        f"search: {{trials: 2, mode: compare, compare: {{{TUNED}, tac.alpha: [1, 2]}}, "
        "space: {tac.tau: {float: [0.1, 1]}}}",
        "compare.tac must not vary what compare.tac.alpha varies, got tac.alpha in both",
    ),
    (
        "search: {trials: 2, space: {tac: {choice: [{alpha: 0.1}, {alpha: 0.2}]}, "
        "tac.alpha: {float: [0.1, 1]}}}",
        "space.tac must not vary what space.tac.alpha varies, got tac.alpha in both",
    ),
    (
        "search: {trials: 2, space: {tac: {choice: [{tau: 0.1}, {alpha: 0.2}]}, "
        "tac.alpha: {float: [0.1, 1], when: {tac: {alpha: 0.2}}}}}",
        "search.space.tac must not hold a field that varies by itself too, got alpha",
    ),
    (
        "search: {trials: 2, mode: compare, compare: {tac: [{tau: 0.1}, {tau: 0.2}]}, "
        "space: {tac: {choice: [{alpha: 0.1}, {alpha: 0.2}]}}}",
        "compare.tac must not vary what space.tac varies, got tac in both",
    ),
]


@pytest.mark.parametrize(("varied", "message"), TWICE)
def test_a_field_of_a_group_varies_once(tmp_path: Path, varied: str, message: str) -> None:
    stage = f"{{name: a, variant: tac, {varied}}}"
    text = f"name: mine\ntasks: [FetchReach]\nstages: [{stage}]\n"
    assert message in mistake(tmp_path, text=text)


def test_a_field_may_vary_if_the_group_lacks_it(tmp_path: Path) -> None:
    alpha = "tac.alpha: {float: [0.1, 1], when: {tac: {tau: 0.1}}}"
    space = f"{{tac: {{choice: [{{tau: 0.1}}, {{alpha: 0.2}}]}}, {alpha}}}"
    stage = f"{{name: a, variant: tac, search: {{trials: 2, space: {space}}}}}"
    assert load(tmp_path, text=f"name: mine\ntasks: [FetchReach]\nstages: [{stage}]\n").stages


REFUSED: list[tuple[str, str]] = [
    ("q=2", "command line: q is not a known setting (did you mean 'tac.entropic_index'?)"),
    ("tac.lr=-1", "command line: tac.lr must be > 0, got -1"),
    ("tac.hidden_sizes=[8, 0]", "command line: tac.hidden_sizes[1] must be > 0, got 0"),
    ("tac.entropic_index=2", "stages.second.grid.tac.entropic_index='[2]' replaces its values"),
    ("tac.entropic_index=[1, 2]", "grid.tac.entropic_index='[1, 2]' replaces its values"),
    ("stages.second.tac.entropic_index=2", "second.grid.tac.entropic_index='[2]' replaces its"),
    ("stages.second.tac={entropic_index: 2}", "where stages.second.grid.tac.entropic_index varies"),
    (
        "stages.second.per_task.FetchReach.tac.entropic_index=2",
        "where stages.second.grid.tac.entropic_index varies",
    ),
    ("tac.alpha=[.1, .2]", "belong in a stage's grid: {tac.alpha: [0.1, 0.2]}"),
    ("stages.third.env_steps=1", "must be stages.NAME.KEY, with NAME one of first, second"),
    ("stages.first.q=1", "stages.first.q is not a known setting (did you mean 'tac.entropic"),
    ("seeds=0", "command line: seeds must be a list like [0, 1], or a number (1 to "),
    ("env_steps=1.5", "command line: env_steps must be a whole number, got 1.5"),
    ("tac.lr", "command line: must be KEY=VALUE like tac.alpha=0.1"),
    ("tac.lr=[", "command line: tac.lr must be valid YAML"),
    ("tac.aplha=1", "tac.aplha is not a known setting (did you mean 'tac.alpha'?)"),
    ("storage=", "command line: storage must be text, got null"),
    ("tasks.0=1", 'command line: tasks.0 must be inside of a mapping, got ["FetchReach"] at tasks'),
    ("tac.alpha.value=1", "command line: tac.alpha.value must be a whole setting, tac.alpha="),
    ("preset=~nobody-at-all/x.yaml", "preset must be a file in an existing home folder, got"),
    ("tac={tau: 2}", "command line: tac.tau must be <= 1, got 2"),
]


@pytest.mark.parametrize(("argument", "message"), REFUSED, ids=[one for one, _ in REFUSED])
def test_each_mistake_of_the_command_line_is_reported_once(
    tmp_path: Path, argument: str, message: str
) -> None:
    assert message in mistake(tmp_path, argument)


def test_mistakes_of_two_arguments(tmp_path: Path) -> None:
    for arguments, message in (
        (("stages.first.per_task=5", "tac.lr=0.1"), "per_task must be a mapping of keys to values"),
        (("tac.lr=0.1", "tac={lr: 0.2}"), "command line: tac.lr must not repeat"),
    ):
        assert message in mistake(tmp_path, *arguments)


FILES: list[tuple[str, Any]] = [
    ("defaults: {q: 1.5}", "defaults.q is not a known setting (did you mean 'tac.entropic_index'"),
    ("q: 1.5", "q is not a known setting (did you mean 'defaults.tac.entropic_index'?)"),
    ("defaults: {tac: {q: 1.5}}", "defaults.tac.q is not a known setting (did you mean 'tac.entro"),
    ("defaults: {tac: {alpha: [.1, .2]}}", "got [0.1, 0.2]; values to compare belong in a stage's"),
    ("defaults: {env_steps: 1e6, num_envs: 1.5}", "num_envs must be a whole number, got 1.5"),
    ("defaults: {tac: {random_steps: 3e5}}", "env_steps must be > tac.random_steps (300000)"),
]


@pytest.mark.parametrize(("text", "message"), FILES, ids=[text for text, _ in FILES])
def test_each_mistake_of_a_file_is_reported_once(tmp_path: Path, text: str, message: str) -> None:
    stage = "{name: a, variant: tac, grid: {tac.entropic_index: [1, 2, 3], tac.tau: [.1, .2]}}"
    content = f"name: mine\ntasks: [FetchReach]\n{text}\nstages: [{stage}]\n"
    assert message in mistake(tmp_path, text=content)


def test_an_unknown_key_of_a_grid_is_one_mistake(tmp_path: Path) -> None:
    stage = "{name: a, variant: tac, grid: {q: [1, 2, 3], tac.gamma: [0.9, 1.5, 2]}}"
    with pytest.raises(ConfigError) as refusal:
        load(tmp_path, text=f"name: mine\ntasks: [FetchReach]\nstages: [{stage}]\n")
    assert list(refusal.value.lines) == [
        "sweep.yaml:3: stages.a.grid.q is not a known setting (did you mean 'tac.entropic_index'?)",
        "sweep.yaml:3: stages.a.grid.tac.gamma[1] must be < 1, got 1.5",
        "sweep.yaml:3: stages.a.grid.tac.gamma[2] must be < 1, got 2",
    ]


OF_SOURCE = """
name: mine
tasks: [FetchPush]
stages:
  - {name: before, variant: music-u}
  - name: after
    variant: music-r
    init_from: before
    search: {space: {"before:tac.lr": {choice: [0.001, 0.002]}}, trials: 2}
"""


def test_a_search_varies_a_setting_of_its_source_only(tmp_path: Path) -> None:
    refused = mistake(tmp_path, "stages.before.tac.lr=0.01", text=OF_SOURCE)
    assert "stages.after.search.space.before:tac.lr varies it" in refused
    config = load(tmp_path, "stages.after.tac.lr=0.01", text=OF_SOURCE)
    assert config.stage("after").points[0].runs["FetchPush"].tac.lr == 0.01
    with pytest.raises(ConfigError):
        load(tmp_path, "tac.lr=0.01", text=OF_SOURCE)


OWN = "{reward: rnd, settings: {hidden: 32, features: 8}}"


def test_a_part_of_a_setting_keeps_the_others_or_is_refused(tmp_path: Path) -> None:
    text = "name: s\ntasks: [FetchPush]\nstages:\n  - {name: a, variant: tac"
    within = f"{text}, intrinsic: {OWN}}}\n"
    config = load(tmp_path, "stages.a.intrinsic.settings.hidden=64", text=within)
    settings = config.stage("a").points[0].runs["FetchPush"].intrinsic.settings
    assert dict(settings) == {"hidden": 64, "features": 8}
    above = f"{text}}}\ndefaults: {{intrinsic: {OWN}}}\n"
    refused = mistake(tmp_path, "stages.a.intrinsic.settings.hidden=64", text=above)
    assert "must be a whole setting, stages.a.intrinsic.settings={...}, got a part" in refused


def test_a_reward_in_a_group_of_a_grid_is_no_secret(tmp_path: Path) -> None:
    grid = "{intrinsic: [{reward: 'my_token:Reward'}, {reward: rnd}]}"
    text = f"name: s\ntasks: [FetchPush]\nstages: [{{name: a, variant: tac, grid: {grid}}}]\n"
    assert len(load(tmp_path, text=text).stage("a").points) == 2
