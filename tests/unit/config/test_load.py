"""A sweep's file: layers, variants, and mistakes with place, rule and value."""

import copy
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from music_rllib.config.problems import ConfigError
from music_rllib.config.run_settings import RunSettings, handed_over, variant_music
from music_rllib.config.schema import SweepConfig
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.results.analysis_plan import analysis_plan
from music_rllib.schedules import Linear
from tests.handoffs import music_u, write_estimator
from tests.played_search import document
from tests.sweep_files import loaded

Document = dict[str, Any]

SOUND: Document = {
    "name": "sound",
    "tasks": ["FetchPush"],
    "seeds": [3, 5],
    "defaults": {"env_steps": 6000, "tac": {"lr": 0.002}},
    "stages": [
        {"name": "pretrain", "variant": "music-u", "tac": {"entropic_index": 1.0}},
        {
            "name": "finetune",
            "variant": "music-r",
            "init_from": "pretrain",
            "grid": {"tac.entropic_index": [1.0, 1.5]},
        },
    ],
}


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., SweepConfig]:
    return partial(loaded, tmp_path)


@pytest.fixture
def problems(load: Callable[..., SweepConfig]) -> Callable[[Document], list[str]]:
    def problems_of(document: Document) -> list[str]:
        with pytest.raises(ConfigError) as refusal:
            load(document)
        return list(refusal.value.lines)

    return problems_of


def changed(**changes: Any) -> Document:
    return copy.deepcopy(SOUND) | changes


def with_stage(position: int, **changes: Any) -> Document:
    document = copy.deepcopy(SOUND)
    document["stages"][position] |= changes
    return document


def run_of(config: SweepConfig, stage: int = 0, point: int = 0) -> RunSettings:
    return next(iter(config.stages[stage].points[point].runs.values()))


def test_a_valid_file_is_resolved(load: Callable[..., SweepConfig]) -> None:
    config = load(SOUND)
    assert (config.name, config.seeds, config.storage) == ("sound", (3, 5), "results")
    assert [stage.name for stage in config.stages] == ["pretrain", "finetune"]
    pretrain, finetune = config.stages
    assert pretrain.source is None
    assert finetune.source is not None
    assert finetune.source.stage == "pretrain"
    assert [point.values for point in finetune.points] == [
        {"tac.entropic_index": 1.0},
        {"tac.entropic_index": 1.5},
    ]
    run = run_of(config, stage=1, point=1)
    assert run.task == BUILT_IN_TASKS["FetchPush"]
    assert (run.env_steps, run.tac.lr, run.tac.entropic_index) == (6000, 0.002, 1.5)
    assert (run.music.estimator, run.music.mi_reward_weight) == ("frozen", 1.0)
    assert RunSettings.model_validate_json(run.model_dump_json(), strict=True) == run


def test_a_number_of_seeds_keeps_the_seeds_of_the_file(load: Callable[..., SweepConfig]) -> None:
    assert load(changed(seeds=[1e3, 7]), seeds="3").seeds == (1000, 7, 0)


def test_higher_layers_replace_lower_layers(load: Callable[..., SweepConfig]) -> None:
    document = changed(
        defaults={"env_steps": 6000, "tac": {"gamma": 0.9, "tau": 0.1, "lr": 0.1}},
        stages=[
            {
                "name": "a",
                "variant": "tac",
                "tac": {"tau": 0.2, "lr": 0.2},
                "grid": {"tac.lr": [0.3]},
            }
        ],
    )
    tac = run_of(load(document)).tac
    assert (tac.gamma, tac.tau, tac.lr) == (0.9, 0.2, 0.3)


def test_a_group_in_a_grid_is_merged_field_by_field(load: Callable[..., SweepConfig]) -> None:
    """Settings that it does not name are kept, as in every layer: here the preset's networks."""
    tuned = [{"entropic_index": 1.0, "alpha": 0.05}, {"entropic_index": 1.5, "alpha": 0.15}]
    document = changed(preset="small")
    plain = run_of(load(document), stage=1).tac
    document["stages"][1] |= {"tac": {"tau": 0.2}, "grid": {"tac": tuned}}
    config = load(document)
    for point, group in enumerate(tuned):
        tac = run_of(config, 1, point).tac
        assert tac == plain.model_copy(update={"tau": 0.2, **group})


def test_a_schedule_replaces_a_lower_schedule_completely(load: Callable[..., SweepConfig]) -> None:
    ramp = {"schedule": "linear", "start": 1.0, "end": 2.0, "begin": 0.2}
    document = changed(
        defaults={"env_steps": 6000, "tac": {"alpha": {"learned": True}, "entropic_index": ramp}},
        stages=[
            {
                "name": "a",
                "variant": "tac",
                "tac": {"alpha": 0.1},
                "grid": {"tac.entropic_index.end": [1.5, 3.0]},
            }
        ],
    )
    config = load(document)
    assert run_of(config).tac.alpha == 0.1
    assert run_of(config, point=1).tac.entropic_index == Linear(start=1.0, end=3.0, begin=0.2)


def test_a_missing_alpha_target_keeps_the_node_key(
    load: Callable[..., SweepConfig],
) -> None:
    stages = [{"name": "a", "variant": "tac", "tac": {"alpha": {"learned": True}}}]
    alpha = run_of(load(changed(stages=stages))).identity()["tac"]["alpha"]
    assert alpha == {"learned": True, "initial": 0.2, "target_entropy": "auto", "lr": 3e-4}


def test_the_grid_is_a_product_with_the_last_key_fastest(
    load: Callable[..., SweepConfig],
) -> None:
    grid = {"tac.alpha": [0.1, 0.2], "env_steps": [5000, 6000, 7000]}
    stages = [{"name": "a", "variant": "tac", "grid": grid}]
    points = load(changed(stages=stages)).stages[0].points
    assert [tuple(point.values.values()) for point in points] == [
        (alpha, steps) for alpha in (0.1, 0.2) for steps in (5000, 6000, 7000)
    ]
    assert [run.env_steps for point in points for run in point.runs.values()] == [
        5000,
        6000,
        7000,
    ] * 2


def test_slide_has_half_the_weight_by_default(load: Callable[..., SweepConfig]) -> None:
    document = changed(tasks=["FetchPush", "FetchSlide"])
    runs = load(document).stages[1].points[0].runs
    assert {name: run.music.mi_reward_weight for name, run in runs.items()} == {
        "FetchPush": 1.0,
        "FetchSlide": 0.5,
    }
    document["defaults"]["music"] = {"mi_reward_weight": 0.25}
    runs = load(document).stages[1].points[0].runs
    assert {run.music.mi_reward_weight for run in runs.values()} == {0.25}


def test_per_task_settings_are_between_stage_and_grid(
    load: Callable[..., SweepConfig],
) -> None:
    stage = {
        "name": "a",
        "variant": "tac",
        "tac": {"tau": 0.2, "lr": 0.2, "gamma": 0.8},
        "per_task": {"FetchSlide": {"env_steps": 9000, "tac": {"lr": 0.3, "tau": 0.3}}},
        "grid": {"tac.lr": [0.4]},
    }
    runs = load(changed(tasks=["FetchPush", "FetchSlide"], stages=[stage])).stages[0].points[0].runs
    assert {
        name: (run.env_steps, run.tac.lr, run.tac.tau, run.tac.gamma) for name, run in runs.items()
    } == {"FetchPush": (6000, 0.4, 0.2, 0.8), "FetchSlide": (9000, 0.4, 0.3, 0.8)}


def test_options_replace_values_of_the_file(load: Callable[..., SweepConfig]) -> None:
    config = load(SOUND, name="other", storage="elsewhere")
    assert (config.name, config.storage) == ("other", "elsewhere")
    with pytest.raises(ConfigError, match=r"^--name: name must be letters, .*got \"a b\"$"):
        load(SOUND, name="a b")


def test_defaults_without_effect_on_a_variant_are_ignored(
    load: Callable[..., SweepConfig],
) -> None:
    stages = [{"name": "base", "variant": "tac"}]
    plain = load(changed(stages=stages))
    document = changed(stages=stages)
    document["defaults"]["music"] = {"mi_reward_weight": 0.5, "lr": 0.1}
    assert run_of(load(document)) == run_of(plain)


def test_music_p_ignores_the_priority_of_the_defaults(
    load: Callable[..., SweepConfig],
) -> None:
    stages = [{"name": "pretrain", "variant": "music-u"}]
    stages += [{"name": "ranked", "variant": "music-p", "init_from": "pretrain"}]
    replay = {"priority": "td_error", "priority_exponent": 0.3}
    runs = [
        stage.points[0].runs["FetchPush"]
        for stage in load(changed(stages=stages, defaults={"replay": replay})).stages
    ]
    assert [run.replay.priority for run in runs] == ["td_error", "uniform"]


def test_a_users_task(load: Callable[..., SweepConfig]) -> None:
    task = {"env_id": "Pendulum-v1", "horizon": 200, "success_key": None}
    document = changed(
        environments={"Swing": task},
        tasks=["Swing"],
        stages=[{"name": "a", "variant": "tac"}],
    )
    assert run_of(load(document)).task.env_id == "Pendulum-v1"


def asking(hypothesis: str, **analysis: Any) -> Document:
    return changed(analysis={"hypotheses": [hypothesis], **analysis})


def test_the_compared_stage_is_the_one_of_the_analysis(load: Callable[..., SweepConfig]) -> None:
    stages = [
        {"name": "reach", "variant": "tac", "grid": {"tac.entropic_index": [1.0, 1.5]}},
        {"name": "other", "variant": "tac"},
    ]
    assert load(changed(stages=stages)).stage().name == "other"
    explores = [stages[0], {"name": "explore", "variant": "music-u"}]
    assert load(changed(stages=explores)).stage().name == "reach"
    analysis = {"hypotheses": ["q = 1.5 against q = 1"], "stage": "reach"}
    config = load(changed(stages=stages, analysis=analysis))
    assert config.stage().name == "reach"
    assert config.stage("other").name == "other"


def without_success(document: Document) -> Document:
    task = {"env_id": "Pendulum-v1", "horizon": 50, "success_key": None}
    grid = {"tac.entropic_index": [1.0, 1.5]}
    stages = [{"name": "a", "variant": "tac", "grid": grid}]
    return document | {"environments": {"Swing": task}, "tasks": ["Swing"], "stages": stages}


def test_a_group_of_the_grid_gives_each_q_its_alpha(
    load: Callable[..., SweepConfig],
) -> None:
    tuned = [{"entropic_index": 1.0, "alpha": 0.05}, {"entropic_index": 1.5, "alpha": 0.15}]
    document = asking("q = 1.5 better than q = 1", stage="finetune")
    document["stages"][1]["grid"] = {"tac": tuned}
    plan = analysis_plan(load(document))
    assert plan is not None
    assert plan.control == "α of its own for each q: 0.05 at q = 1, 0.15 at q = 1.5"
    document["analysis"]["hypotheses"] = ["q = 1.5, alpha = 0.2 against q = 1"]
    with pytest.raises(ConfigError, match=r"\(tac.alpha: 0.05, 0.15\), got 0.2"):
        load(document)


def test_auc_total_counts_the_steps_of_the_stages_before(load: Callable[..., SweepConfig]) -> None:
    document = asking("q = 1.5 better than q = 1", stage="finetune")
    budgets = {}
    for metric in ("auc", "auc_total"):
        document["analysis"]["metric"] = metric
        plan = analysis_plan(config := load(document))
        assert plan is not None
        budgets[metric] = plan.budget
    (before,) = config.stages[0].points
    assert budgets["auc_total"] == {
        task: steps + before.runs[task].env_steps for task, steps in budgets["auc"].items()
    }


def test_a_storage_can_name_environment_variables(
    load: Callable[..., SweepConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCRATCH", "/scratch/me")
    assert load(changed(storage="$SCRATCH/a")).storage == "/scratch/me/a"
    assert load(changed(storage="s3://b/${SCRATCH}-a$")).storage == "s3://b//scratch/me-a$"
    monkeypatch.setenv("SCRATCH", "")
    with pytest.raises(ConfigError, match=r"sweep\.yaml:\d+: storage must .* got \$SCRATCH in"):
        load(changed(storage="$SCRATCH/a"))
    # A sweep's own folder, or a pattern that the shell has already expanded.
    assert load(changed(storage="$SCRATCH/a"), storage="/x$y/a").storage == "/x$y/a"


BAD: list[tuple[Document, str]] = [
    (changed(name=1), "sweep.yaml:1: name must be text, got 1"),
    (changed(name="nodes"), "name must not be 'nodes'"),
    (changed(name="environments.json"), "name must not be 'environments.json'"),
    (
        changed(
            environments={
                "M": {"env_id": "m:M", "horizon": 9, "env_kwargs": {"pass_through": True}}
            }
        ),
        "environments.M.env_kwargs.pass_through must have another name or value: this one looks",
    ),
    (changed(storag="x"), "storag is not a known setting (did you mean 'storage'?)"),
    (changed(tasks=["FetchPsh"]), "got 'FetchPsh' (did you mean 'FetchPush'?)"),
    (changed(tasks=[]), "tasks must not be empty, got []"),
    (changed(tasks=["FetchPush", "FetchPush"]), 'tasks[1] must not repeat, got "FetchPush" again'),
    (
        changed(tasks=["FetchReach"], stages=[{"name": "pretrain", "variant": "music-u"}]),
        "must have agent_indices and surrounding_indices for mus",
    ),
    (changed(seeds=[0, 0]), "seeds[1] must not repeat, got 0 again"),
    (changed(seeds=[-1]), "seeds[0] must be >= 0, got -1"),
    (changed(seeds=[True]), "seeds[0] must be a whole number, got true"),
    (changed(seeds="3"), "seeds must be a list, got \"3\" (did you mean '[3]'?)"),
    (changed(tasks="FetchPush, FetchSlide"), "(did you mean '[FetchPush, FetchSlide]'?)"),
    (changed(resources={"num_cpus": 0}), "resources.num_cpus must be > 0, got 0"),
    (
        changed(resources={"num_cpus": 2, "cpus_per_run": 3}),
        "resources.cpus_per_run must be <= num_cpus (2), got 3",
    ),
    (changed(mlflow={"tracking_url": "x"}), "(did you mean 'mlflow.tracking_uri'?)"),
    (changed(environments={"FetchPush": {}}), "environments.FetchPush is a built-in task"),
    (changed(environments={"A": {"env_id": "A-v0"}}), "environments.A.horizon must be given"),
    (changed(defaults={"env_steps": 6.5e-1}), "env_steps must be a whole number, got 0.65"),
    (changed(defaults={"seed": 1}), "defaults.seed is not a known setting"),
    (changed(defaults={"tac": 5}), "defaults.tac must be a mapping of keys to values, got 5"),
    (changed(defaults={"tac": {"lr": "fast"}}), 'defaults.tac.lr must be a number, got "fast"'),
    (
        changed(defaults={"env_steps": 500}),
        "defaults.env_steps must be > tac.random_steps (1000), or",
    ),
    (changed(defaults={"replay": {"capacity": 100}}), "replay.capacity must hold one episode"),
    (changed(stages=[]), "stages must not be empty, got []"),
    (changed(stages=[1]), "stages[0] must be a mapping of keys to values, got 1"),
    (with_stage(0, variant="music-x"), "stages.pretrain.variant must be 'tac', 'music-u'"),
    (with_stage(0, variant="tac"), "stage with an estimator, got 'pretrain', which is tac"),
    (with_stage(0, lr=1), "stages.pretrain.lr is not a known setting"),
    (with_stage(0, tac={"entropic_index": 0}), "entropic_index must be > 0, got 0"),
    (with_stage(0, tac={"entropic_index": float("nan")}), "must be a finite number, got nan"),
    (with_stage(0, tac={"entropic_index": "one"}), 'must be a number, got "one"'),
    (
        with_stage(0, tac={"entropic_index": {"schedule": "linear", "start": 1.0}}),
        "stages.pretrain.tac.entropic_index.end must be given",
    ),
    (
        with_stage(0, tac={"alpha": "auto"}),
        'alpha must be a number, a schedule, or {learned: true}, got "auto"',
    ),
    (
        with_stage(0, tac={"alpha": {"learned": True, "initial": -1.0}}),
        "stages.pretrain.tac.alpha.initial must be > 0, got -1.0",
    ),
    (
        with_stage(
            0, tac={"alpha": {"learned": True, "target_shannon": -4.0, "target_width": 0.1}}
        ),
        "only one target can be given, got target_shannon and target_width",
    ),
    (
        with_stage(0, tac={"alpha": {"value": 0.1, "matched_width": 0.0}}),
        "stages.pretrain.tac.alpha.matched_width must be > 0, got 0",
    ),
    (
        with_stage(0, tac={"alpha": {"value": 0.1, "normalised": False}}),
        "stages.pretrain.tac.alpha.normalised must be",
    ),
    (with_stage(0, tac={"hiden_sizes": [1]}), "(did you mean 'tac.hidden_sizes'?)"),
    (
        with_stage(
            0,
            tac={
                "alpha": {"learned": True, "target_entropy": -3.0},
                "entropic_index": {"schedule": "linear", "start": 1.0, "end": 2.0},
            },
        ),
        "stages.pretrain.tac.alpha.target_entropy must be auto where entropic_index is a schedule "
        "(a value of S_q means another width at each q), got -3; "
        "target_shannon and target_width hold for every q",
    ),
    (
        with_stage(0, tac={"log_std_bounds": [1.0, 0.0]}),
        "stages.pretrain.tac.log_std_bounds must be increasing, got 1, 0",
    ),
    (
        with_stage(0, tac={"target_critics": 3}),
        "stages.pretrain.tac.target_critics must be <= critics (2), got 3",
    ),
    (
        with_stage(0, tac={"quantiles": 5}),
        "stages.pretrain.tac: bootstrap must be 'critics' with quantiles",
    ),
    (
        with_stage(0, tac={"bootstrap": "critics", "quantiles": 5, "dropped_quantiles": 5}),
        "stages.pretrain.tac.dropped_quantiles must be < quantiles (5), got 5",
    ),
    (
        with_stage(
            0, tac={"entropic_index": {"follows": "success_rate", "points": [[0, 0], [1, 1]]}}
        ),
        "stages.pretrain.tac.entropic_index must be > 0, got 0",
    ),
    (
        with_stage(
            0,
            tac={
                "policy": "deterministic",
                "alpha": 0.0,
                "bootstrap": "critics",
                "behaviour": {"kind": "gaussian_noise"},
                "entropic_index": {"follows": "shannon_entropy", "points": [[0, 1], [1, 2]]},
            },
        ),
        "stages.pretrain.tac.entropic_index.follows must not be shannon_entropy for policy: determ",
    ),
    (with_stage(0, music={"goals": "environment"}), 'music.goals must be "zero" for music-u'),
    (with_stage(0, init_from="finetune"), "init_from has no effect with variant music-u"),
    (
        with_stage(0, per_task={"FetchSlide": {}}),
        "FetchSlide is not a task of this stage (",
    ),
    (with_stage(0, per_task={"FetchPush": {"seed": 1}}), "per_task.FetchPush.seed is not a known"),
    (with_stage(0, per_task={"FetchPush": 5}), "per_task.FetchPush must be a mapping"),
    (
        with_stage(0, per_task={"FetchPush": {"tac": {"lr": -1.0}}}),
        "stages.pretrain.per_task.FetchPush.tac.lr must be > 0, got -1.0",
    ),
    (
        with_stage(1, per_task={"FetchPush": {"music": {"lr": 0.1}}}),
        "stages.finetune.per_task.FetchPush.music.lr has no effect with variant music-r",
    ),
    (with_stage(1, init_from=None), "init_from must be given for music-r, which starts from a t"),
    (with_stage(1, init_from="finetune"), "init_from must be an earlier stage (one of pretrain)"),
    (with_stage(1, init_from="pretran"), "got 'pretran' (did you mean 'pretrain'?)"),
    (with_stage(1, init_from={"task": "FetchPush"}), "must have exactly one of stage and check"),
    (with_stage(1, init_from={"stage": "pretrain", "task": "Fetch"}), "got 'Fetch'"),
    (with_stage(1, init_from={"checkpoint": "gone"}), "gone must hold a handoff (handoff.json"),
    (with_stage(1, init_from={"checkpoint": "~nobody-at-all/x"}), "in an existing home folder"),
    (with_stage(1, tasks=["FetchSlide"]), "needs a run of FetchSlide in stage pretrain"),
    (with_stage(1, music={"lr": 0.1}), "music.lr has no effect with variant music-r"),
    (
        with_stage(1, variant="music-p", replay={"priority": "td_error"}),
        "replay.priority has no effect with variant music-p",
    ),
    (
        with_stage(1, music={"prioritise_replay": True}, replay={"priority": "td_error"}),
        "replay.priority must be uniform with music.prioritise_replay, got td_error",
    ),
    (with_stage(1, music={"hidden_size": 64}), "needs the same music.hidden_size in stage finetu"),
    (
        with_stage(0, intrinsic={"reward": "discern"}),
        "goals: zero (music-u) leaves nothing to intrinsic.reward discern",
    ),
    (with_stage(1, music={"bound": "nwj"}), "needs the same music.bound in stage finetune as in"),
    (with_stage(0, intrinsic={"reward": "rdn"}), "intrinsic.reward must be displacement, random"),
    (with_stage(0, intrinsic={"reward": "a b:C"}), "or module:Class of your own, got 'a b:C'"),
    (
        with_stage(0, intrinsic={"reward": "rnd", "settings": {"hiden": 9}}),
        "settings of rnd must be among: hidden, features; got 'hiden'",
    ),
    (
        with_stage(0, intrinsic={"reward": "e3b", "settings": {"ridge": 0}}),
        "settings.ridge must be a number > 0, got 0",
    ),
    (
        with_stage(0, intrinsic={"reward": "rnd", "settings": {"hidden": float("inf")}}),
        "settings.hidden must be a finite number, got inf",
    ),
    (
        with_stage(0, intrinsic={"reward": "rnd", "settings": {"hidden": 2.5}}),
        "settings.hidden must be a whole number >= 1, got 2.5",
    ),
    (
        with_stage(0, intrinsic={"reward": "disagreement", "settings": {"models": 1}}),
        "settings.models must be a whole number >= 2, got 1",
    ),
    (
        changed(
            tasks=["FetchReach"],
            stages=[{"name": "a", "variant": "tac", "intrinsic": {"reward": "displacement"}}],
        ),
        "must have agent_indices and surrounding_indices for intrinsic.reward displacement",
    ),
    (with_stage(0, intrinsic={"weight": -1.0}), "intrinsic.weight must be >= 0, got -1"),
    (with_stage(0, intrinsic={"frozen": True}), "intrinsic.frozen must be false for music-u, got"),
    (
        with_stage(1, variant="intrinsic-u", init_from=None),
        "intrinsic.reward must be given for intrinsic-u",
    ),
    (
        with_stage(1, variant="intrinsic-r", intrinsic={"reward": "rnd"}),
        "must be a stage with intrinsic.reward, got 'pretrain', which has none",
    ),
    (with_stage(1, name="pretrain"), "stages.pretrain.name must not repeat"),
    (with_stage(1, grid={"seed": [1]}), "grid.seed is not a known setting (did you mean 'seeds'?)"),
    (with_stage(1, grid={"tac.entropic_index": []}), "must not be empty, got []"),
    (with_stage(1, grid={"tac.entropic_index": 1.0}), "must be a list, got 1.0"),
    (with_stage(1, grid={"tac.entropic_index": [1, 1.0]}), "[1] must not repeat, got 1.0 again"),
    (with_stage(1, grid={"tac.entropic_index": [1.0, 0]}), "[1] must be > 0, got 0"),
    (with_stage(1, grid={"tac.lr.x": [1]}), "grid.tac.lr.x[0] must be a number, got"),
    (with_stage(1, grid={"entropic_index": [1]}), "(did you mean 'tac.entropic_index'?)"),
    (with_stage(1, grid={"music.lr": [1.0]}), "has no effect with variant music-r"),
    (with_stage(1, grid={"music": [{"lr": 1.0}]}), "grid.music[0].lr has no effect with variant"),
    (with_stage(1, grid={"tac": [{"alfa": 1.0}]}), "alfa is not a known setting (did you mean"),
    (with_stage(1, grid={"tac": [{"lr": -1.0}]}), "grid.tac[0].lr must be > 0, got -1"),
    (
        with_stage(1, grid={"music.estimator": ["none"]}),
        "stages.finetune.music: mi_reward_weight needs an estimator",
    ),
    (asking("q = 1.5 or q = 1"), "analysis.hypotheses[0] must be two different conditions with"),
    (asking("q = 1 against q = 1"), "must be two different conditions with"),
    (asking("q = 3 against q = 1"), "(tac.entropic_index: 1, 1.5), got 3"),
    (asking("lr = 3 against q = 1"), "of which finetune varies tac.entropic_index, got 'lr'"),
    (asking("stage = a against q = 1"), "must name one of the stages pretrain, finetune, got 'a'"),
    (asking("q = 1.5 against q = 1", stage="x"), "analysis.stage must be one of pretrain, finet"),
    (asking("q = 1.5 against q = 1", margin=0), "analysis.margin must be > 0, got 0"),
    (asking("q = 1.5 against q = 1", margin=5), "margin must be < 1 for a success rate (5% is"),
    (
        asking("q = 1.5 against q = 1") | {"defaults": {"tac": {"gamma": 3.0}}},
        "defaults.tac.gamma must be < 1, got 3.0",
    ),
    (
        without_success(asking("q = 1.5 against q = 1")),
        "analysis.margin must be given for tasks without success, got null",
    ),
]


@pytest.mark.parametrize(("document", "message"), BAD, ids=[message[:40] for _, message in BAD])
def test_each_mistake_is_reported(
    problems: Callable[[Document], list[str]], document: Document, message: str
) -> None:
    lines = problems(document)
    assert any(message in line for line in lines), lines
    assert all(line.startswith("sweep.yaml") for line in lines)
    assert len(lines) == 1, "one mistake, one line"


def test_mistakes_in_defaults_are_reported_beside_an_invalid_stage(
    problems: Callable[[Document], list[str]],
) -> None:
    stage = {"name": "train", "variant": "sac"}
    lines = problems(SOUND | {"defaults": {"tac": {"lr": -1}}, "stages": [stage]})
    assert [line.partition(": ")[2].partition(" ")[0] for line in lines] == [
        "defaults.tac.lr",
        "stages.train.variant",
    ]


def test_all_mistakes_are_reported_at_once_in_the_order_of_the_file(
    problems: Callable[[Document], list[str]],
) -> None:
    document = changed(name="a b", tasks=["FetchPsh"], defaults={"tac": {"gamma": 2.0}})
    document["stages"][0]["tac"] = {"alpha": -1.0}
    document["stages"][1]["grid"] = {"tac.entropic_index": [-1.0]}
    document["stages"][1]["init_from"] = "nowhere"
    lines = problems(document)
    assert [line.split(" ")[1] for line in lines] == [
        "name",
        "tasks[0]",
        "defaults.tac.gamma",
        "stages.pretrain.tac.alpha",
        "stages.finetune.init_from",
        "stages.finetune.grid.tac.entropic_index[0]",
    ]
    numbers = [int(line.split(":")[1]) for line in lines]
    assert numbers == sorted(numbers)


def test_policies_need_the_same_networks_on_both_sides(
    load: Callable[..., SweepConfig], problems: Callable[[Document], list[str]]
) -> None:
    stages: list[Document] = [
        {"name": "u", "variant": "music-u"},
        {"name": "f", "variant": "music-f", "init_from": "u"},
    ]
    load(changed(stages=stages))
    stages[1]["tac"] = {"hidden_sizes": [64], "normalise_observations": False, "layer_norm": "all"}
    lines = problems(changed(stages=stages))
    assert [line.split("needs the same ")[1] for line in lines] == [
        "tac.hidden_sizes in stage f as in stage u",
        "tac.layer_norm in stage f as in stage u",
        "tac.normalise_observations in stage f as in stage u",
    ]
    # The same numbers would mean other standard deviations.
    for theirs, ours, wrong in (
        ({}, {"log_std_form": "tanh"}, ["log_std_form"]),
        ({"log_std_form": "tanh"}, {}, ["log_std_form"]),
        (
            {"log_std_form": "tanh"},
            {"log_std_form": "tanh", "log_std_bounds": [-5.0, 2.0]},
            ["log_std_bounds"],
        ),
    ):
        stages[0]["tac"], stages[1]["tac"] = theirs, ours
        lines = problems(changed(stages=stages))
        named = [line.split("needs the same tac.")[1].split(" in stage")[0] for line in lines]
        assert named == wrong
    for same in ({"log_std_bounds": [-5.0, 2.0]}, {"critics": 2}):  # without an effect
        stages[0]["tac"], stages[1]["tac"] = {}, same
        load(changed(stages=stages))


def test_an_intrinsic_reward_is_pretrained_frozen_and_handed_over(
    load: Callable[..., SweepConfig], problems: Callable[[Document], list[str]]
) -> None:
    stages: list[Document] = [
        {"name": "u", "variant": "intrinsic-u"},
        {"name": "r", "variant": "intrinsic-r", "init_from": "u", "intrinsic": {"weight": 0.3}},
    ]
    defaults = {"intrinsic": {"reward": "rnd", "settings": {"hidden": 8}}}
    config = load(changed(stages=stages, defaults=defaults))
    first, second = (run_of(config, i) for i in range(2))
    assert (first.music.task_reward, first.intrinsic.weight, first.intrinsic.frozen) == (0, 1, 0)
    assert (second.music.task_reward, second.intrinsic.weight, second.intrinsic.frozen) == (
        1, 0.3, 1,
    )  # fmt: skip
    assert (handed_over(first), handed_over(second)) == ((), ("intrinsic",))
    stages[1]["intrinsic"]["settings"] = {"hidden": 9}
    (line,) = problems(changed(stages=stages, defaults=defaults))
    assert "needs the same intrinsic.reward and intrinsic.settings in stage r as in stage u" in line


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("tac.hidden_sizes", "tac.hidden_sizes"),
        ("pretrain:tac.hidden_sizes", "tac.hidden_sizes"),
        ("music.hidden_size", "music.hidden_size"),
    ],
)
def test_a_search_may_not_vary_the_source_architecture(
    problems: Callable[[Document], list[str]], name: str, setting: str
) -> None:
    """Its trials would fail one after the other when they load the weights."""
    values = [[64], [128]] if setting == "tac.hidden_sizes" else [64, 128]
    variant = "music-f" if setting == "tac.hidden_sizes" else "music-r"
    search = {"space": {name: {"choice": values}}, "trials": 2}
    lines = problems(with_stage(1, variant=variant, search=search, grid={}))
    assert [f"needs the same {setting} in stage" in line for line in lines] == [True]


def test_an_imported_handoff_is_checked_before_the_start(
    tmp_path: Path,
    load: Callable[..., SweepConfig],
    problems: Callable[[Document], list[str]],
) -> None:
    def from_checkpoint(folder: str, **more: str) -> Document:
        document = with_stage(1, init_from={"checkpoint": folder, **more})
        del document["stages"][0]
        return document

    push = str(write_estimator(tmp_path / "push", music_u()))
    source = load(from_checkpoint(push)).stages[0].source
    assert source is not None
    assert source.checkpoint is not None
    assert source.checkpoint.folder == tmp_path / "push"

    slide = str(write_estimator(tmp_path / "slide", music_u("FetchSlide")))
    (line,) = problems(from_checkpoint(slide))
    assert "must be of task FetchPush, got one of FetchSlide" in line
    load(from_checkpoint(slide, task="FetchSlide"))
    weights = tmp_path / "slide" / "mi_estimator.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    (line,) = problems(from_checkpoint(slide, task="FetchSlide"))
    assert "stages.finetune.init_from" in line
    assert "mi_estimator.safetensors must have" in line

    asked = {"hypotheses": ["q = 1 against q = 2"], "metric": "auc_total"}
    rule = "analysis.metric must not be auc_total where pretraining is outside the sweep"
    lines = problems(from_checkpoint(push) | {"analysis": asked})
    assert sum(rule in line for line in lines) == 1

    of_64 = variant_music("music-u", BUILT_IN_TASKS["FetchPush"]) | {"hidden_size": 64}
    small = str(write_estimator(tmp_path / "small", music_u(music=of_64)))
    (line,) = problems(from_checkpoint(small))
    assert "needs the same music.hidden_size" in line

    document = from_checkpoint(push)
    document["stages"][0]["variant"] = "music-f"
    (line,) = problems(document)
    assert (
        "it lacks policy, critics, value, value_target, normaliser (trained with music-u)" in line
    )

    weights = tmp_path / "push" / "mi_estimator.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    (line,) = problems(from_checkpoint(push))
    assert "mi_estimator.safetensors must have" in line

    (tmp_path / "push" / "handoff.json").write_text("{}")
    (line,) = problems(from_checkpoint(push))
    assert "must be a handoff manifest" in line


@pytest.mark.parametrize(
    ("tac", "extra"),
    [
        ({}, ("value", "value_target", "normaliser")),
        ({"bootstrap": "critics", "normalise_observations": False}, ("critics_target",)),
    ],
)
def test_handed_over_modules_follow_the_architecture(
    tac: dict[str, Any], extra: tuple[str, ...]
) -> None:
    task = BUILT_IN_TASKS["FetchPush"]
    run = RunSettings.model_validate({"task": task, "variant": "music-f", "seed": 0, "tac": tac})
    assert handed_over(run) == ("policy", "critics", *extra)


def test_settings_from_elsewhere_cannot_contradict_their_variant() -> None:
    task = BUILT_IN_TASKS["FetchPush"]
    with pytest.raises(ValueError, match=r'music\.estimator must be "trained" for music-u'):
        RunSettings(task=task, variant="music-u", seed=0)
    reach = BUILT_IN_TASKS["FetchReach"]
    with pytest.raises(ValueError, match="'FetchReach', which has none"):
        RunSettings.model_validate(
            {
                "task": reach,
                "variant": "music-u",
                "seed": 0,
                "music": variant_music("music-u", reach),
            }
        )


def test_each_task_is_compared_with_its_own_source(
    load: Callable[..., SweepConfig], problems: Callable[[Document], list[str]]
) -> None:
    """Tasks may have splits and estimators of different sizes."""
    stages: list[Document] = [
        {"name": "pretrain", "variant": "music-u"},
        {"name": "finetune", "variant": "music-r", "init_from": "pretrain"},
    ]
    tasks = ["FetchPush", "PointCarry"]
    load(changed(tasks=tasks, stages=stages))
    own = {"PointCarry": {"music": {"hidden_size": 64}}}
    both = [stage | {"per_task": own} for stage in stages]
    load(changed(tasks=tasks, stages=both))
    lines = problems(changed(tasks=tasks, stages=[both[0], stages[1]]))
    assert ["needs the same music.hidden_size" in line for line in lines] == [True]
    other = stages[1] | {"init_from": {"stage": "pretrain", "task": "FetchPush"}}
    lines = problems(changed(tasks=tasks, stages=[stages[0], other]))
    assert ["surrounding indices in PointCarry as in FetchPush" in one for one in lines] == [True]


@pytest.mark.parametrize("value", [float("inf"), float("nan"), [1, {"x": float("-inf")}]])
def test_arguments_of_an_environment_are_finite(value: Any, tmp_path: Path) -> None:
    task = {"env_id": "m:M-v0", "horizon": 9, "env_kwargs": {"limit": value}}
    content = document(
        {}, tasks=["M"], environments={"M": task}, stages=[{"name": "t", "variant": "tac"}]
    )
    with pytest.raises(ConfigError) as error:
        loaded(tmp_path, content)
    assert "limit must be a finite number, got" in str(error.value)
    assert "secret" not in str(error.value)


def test_large_seeds_of_the_file_can_be_given_as_an_argument(tmp_path: Path) -> None:
    content = document({}, stages=[{"name": "t", "variant": "tac"}])
    assert loaded(tmp_path, content, seeds="2147483647,1").seeds == (2147483647, 1)
    with pytest.raises(ConfigError, match="must be < 2"):
        loaded(tmp_path, content, seeds="2147483648,1")
