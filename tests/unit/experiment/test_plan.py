"""The plan: its order, its keys, and shared nodes."""

from pathlib import Path
from typing import Any

import pytest

from music_rllib.config.load import load_config
from music_rllib.config.problems import ConfigError
from music_rllib.config.run_settings import variant_music
from music_rllib.envs.tasks import BUILT_IN_TASKS
from music_rllib.experiment import plan as plan_module
from music_rllib.experiment.plan import Plan, make_plan, node_key, remarks
from music_rllib.names import label_matches
from tests.handoffs import music_u
from tests.sweep_files import loaded

Document = dict[str, Any]

PRETRAIN: Document = {"name": "pretrain", "variant": "music-u"}
FINETUNE: Document = {
    "name": "finetune",
    "variant": "music-r",
    "init_from": "pretrain",
    "grid": {"tac.entropic_index": [1.0, 1.5, 2.0]},
}


def plan(tmp_path: Path, **document: Any) -> Plan:
    base = {"name": "s", "tasks": ["FetchPush"], "defaults": {"env_steps": 6000}}
    return make_plan(loaded(tmp_path, base | document))


def test_pretrain_then_finetune(tmp_path: Path) -> None:
    sweep = plan(tmp_path, seeds=[0, 7], stages=[PRETRAIN, FINETUNE])
    assert len(sweep.nodes) == 2 + 3 * 2
    assert sweep.env_steps == 8 * 6000
    assert sweep.imports == ()
    nodes = {node.label: node for node in sweep.nodes}
    assert list(nodes)[:3] == [
        "pretrain/FetchPush/seed0",
        "pretrain/FetchPush/seed7",
        "finetune/FetchPush/tac.entropic_index=1/seed0",
    ]
    for q, seed in ((1.5, 7), (2, 0)):
        node = nodes[f"finetune/FetchPush/tac.entropic_index={q}/seed{seed}"]
        source = nodes[f"pretrain/FetchPush/seed{seed}"]
        assert node.input is not None
        assert (node.input.key, node.input.task.name) == (source.key, "FetchPush")
        assert (node.run.tac.entropic_index, node.run.seed) == (q, seed)


def test_the_grid_of_a_source_multiplies_the_runs(tmp_path: Path) -> None:
    gridded = PRETRAIN | {"grid": {"tac.alpha": [0.1, 0.2]}}
    sweep = plan(tmp_path, stages=[gridded, FINETUNE])
    runs = [run for run in sweep.runs if run.stage == "finetune"]
    assert [run.trial for run in runs] == list(range(6))
    assert runs[4].label == (
        "finetune/FetchPush/pretrain:tac.alpha=0.2,tac.entropic_index=1.5/seed0"
    )
    assert len({run.label for run in sweep.runs}) == len(sweep.runs) == len(sweep.nodes) == 8


@pytest.mark.parametrize(
    ("setting", "value", "label"),
    [
        ("tac.hidden_sizes", [256, 128], "256x128"),
        ("tac.target_bounds", [-20, 0], "[-20,0]"),
        ("tac.target_bounds", [1, 50.5], "[1,50.5]"),
        (
            "tac.alpha",
            {"schedule": "piecewise", "points": [[0, 0.2], [500, 0.1]]},
            "{schedule:piecewise,points:[[0,0.2],[500,0.1]]}",
        ),
    ],
)
def test_only_layer_sizes_are_joined_with_x(
    tmp_path: Path, setting: str, value: Any, label: str
) -> None:
    stage = {"name": "train", "variant": "tac", "grid": {setting: [value]}}
    sweep = plan(tmp_path, stages=[stage])
    assert sweep.runs[0].label == f"train/FetchPush/{setting}={label}/seed0"
    assert label_matches(f"{setting}={label}/seed0", sweep.runs[0].label)


def test_equal_computations_are_one_node(tmp_path: Path) -> None:
    twin = PRETRAIN | {"name": "twin"}
    sweep = plan(tmp_path, stages=[PRETRAIN, twin, FINETUNE | {"init_from": "twin"}])
    assert [run.stage for run in sweep.runs][:2] == ["pretrain", "twin"]
    assert sweep.runs[0].key == sweep.runs[1].key
    assert len(sweep.nodes) == 4
    direct = plan(tmp_path, stages=[PRETRAIN, FINETUNE])
    assert {node.key for node in direct.nodes} == {node.key for node in sweep.nodes}
    assert remarks(direct) == []
    assert remarks(sweep) == [
        "twin: 1 run equal to runs of pretrain: trained once, and counted for pretrain only in "
        "reports, comparisons and hypotheses"
    ]


@pytest.mark.parametrize(
    "sound",
    [
        {"entropic_index": 1.5},
        {"alpha": 0.1},
        {"entropy_form": "per_dimension"},
        {"target_bounds": [-50, 50]},
    ],
)
def test_a_learned_alpha_that_can_diverge_is_remarked(sound: Document, tmp_path: Path) -> None:
    tac = {"entropic_index": 2.0, "entropy_form": "joint", "alpha": {"learned": True}}
    (line,) = remarks(plan(tmp_path, stages=[PRETRAIN | {"tac": tac}]))
    assert line.startswith("1 run with q >= 2 and the joint entropy")
    assert not remarks(plan(tmp_path, stages=[PRETRAIN | {"tac": tac | sound}]))


def test_another_tasks_estimator(tmp_path: Path) -> None:
    finetune = FINETUNE | {
        "tasks": ["FetchPickAndPlace"],
        "init_from": {"stage": "pretrain", "task": "FetchPush"},
    }
    sweep = plan(tmp_path, stages=[PRETRAIN, finetune])
    push = sweep.nodes[0]
    assert push.run.task.name == "FetchPush"
    for node in sweep.nodes[1:]:
        assert node.run.task.name == "FetchPickAndPlace"
        assert node.input is not None
        assert (node.input.key, node.input.task.name) == (push.key, "FetchPush")


def test_keys_ignore_names_places_and_resources(tmp_path: Path) -> None:
    plain = plan(tmp_path, stages=[PRETRAIN, FINETUNE])
    renamed = plan(
        tmp_path,
        name="other",
        storage="elsewhere",
        resources={"num_cpus": 1},
        mlflow={"tracking_uri": "http://localhost:5000"},
        tasks=["Mine"],
        environments={
            "Mine": BUILT_IN_TASKS["FetchPush"].model_dump(exclude={"name"}),
        },
        stages=[PRETRAIN | {"name": "one"}, FINETUNE | {"name": "two", "init_from": "one"}],
    )
    assert [node.key for node in renamed.nodes] == [node.key for node in plain.nodes]


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 1},
        {"env_steps": 200_001},
        {"num_envs": 5},
        {"evaluation": {"episodes": 21}},
        {"tac": {"lr": 0.0011}},
        {"tac": {"log_std_form": "tanh"}},
        {"replay": {"hindsight_k": 1.0}},
        {"intrinsic": {"reward": "rnd"}},
        {"music": variant_music("music-u", BUILT_IN_TASKS["FetchPush"]) | {"lr": 0.0011}},
        {"task": BUILT_IN_TASKS["FetchPush"].model_copy(update={"horizon": 49})},
        {"task": BUILT_IN_TASKS["FetchPickAndPlace"]},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_every_setting_is_part_of_the_key(changes: dict[str, Any]) -> None:
    assert node_key(music_u(**changes), None) != node_key(music_u(), None)


def test_moved_distance_is_part_of_the_key_only_if_used() -> None:
    task = BUILT_IN_TASKS["FetchPush"].model_copy(update={"moved_distance": 0.02})
    assert node_key(music_u(task=task), None) == node_key(music_u(), None)
    moved = {"replay": {"hindsight_episodes": "moved"}}
    assert node_key(music_u(task=task, **moved), None) != node_key(music_u(**moved), None)


def test_symmetries_are_part_of_the_key_only_if_used() -> None:
    push = BUILT_IN_TASKS["FetchPush"]
    mirror = push.symmetries.model_copy(update={"translate": ()})
    other = push.model_copy(update={"symmetries": mirror})
    assert node_key(music_u(task=other), None) == node_key(music_u(), None)
    used = {"replay": {"symmetries": ["mirror"]}}
    keys = [node_key(music_u(task=task, **used), None) for task in (push, other)]
    assert keys[0] == keys[1] != node_key(music_u(), None)
    both = {"replay": {"symmetries": ["translate", "mirror"]}}
    assert node_key(music_u(**both), None) == node_key(
        music_u(replay={"symmetries": ["mirror", "translate"]}), None
    )
    block = BUILT_IN_TASKS["HandManipulateBlock"]
    with pytest.raises(ValueError, match="got mirror: HandManipulateBlock has none"):
        music_u(task=block, **used)


def test_settings_of_no_intrinsic_reward_are_not_part_of_the_key() -> None:
    assert node_key(music_u(intrinsic={"weight": 0.7}), None) == node_key(music_u(), None)
    keys = {
        node_key(music_u(intrinsic={"reward": "rnd", **changes}), None)
        for changes in ({}, {"weight": 0.7}, {"lr": 0.01}, {"settings": {"hidden": 8}})
    }
    assert len(keys) == 4


def test_source_and_algorithm_version_are_part_of_the_key(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    keys = {node_key(music_u(), None), node_key(music_u(), "a"), node_key(music_u(), "b")}
    monkeypatch.setattr(plan_module, "ALGORITHM_VERSION", "other")
    keys.add(node_key(music_u(), None))
    assert len(keys) == 4


def test_an_explicit_default_does_not_change_the_key() -> None:
    spelt = music_u(tac={"lr": 1e-3, "entropic_index": 1}, env_steps=200_000)
    assert node_key(spelt, None) == node_key(music_u(), None)


def test_keys_are_the_same_on_another_machine(tmp_path: Path) -> None:
    """Finished runs are found by these strings, on any machine and at any time.

    They change with a setting's default, a new setting that is not in `YOUNGER`, or
    `ALGORITHM_VERSION`, and then every run is retrained: change them only if that is
    intended. Runs of version 2 are found by theirs for docs/lab/appendix.md.
    """
    sweep = plan(tmp_path, stages=[PRETRAIN, FINETUNE])
    assert {node.label: node.key for node in sweep.nodes} == KEYS
    earlier = make_plan(load_config(tmp_path / "sweep.yaml"), algorithm="2")
    assert {node.label: node.key for node in earlier.nodes} == KEYS_OF_VERSION_2


KEYS = {
    "pretrain/FetchPush/seed0": "ea9428064c458e8b04d9",
    "finetune/FetchPush/tac.entropic_index=1/seed0": "075b140e74cd7f64f744",
    "finetune/FetchPush/tac.entropic_index=1.5/seed0": "f7440a76dcf62f5cb095",
    "finetune/FetchPush/tac.entropic_index=2/seed0": "4077710c934204f6c8da",
}
KEYS_OF_VERSION_2 = {
    "pretrain/FetchPush/seed0": "cc3633961479f4eba8e8",
    "finetune/FetchPush/tac.entropic_index=1/seed0": "114f4269fa291261ddf3",
    "finetune/FetchPush/tac.entropic_index=1.5/seed0": "2429de382d2fc45ca2c8",
    "finetune/FetchPush/tac.entropic_index=2/seed0": "f95441a1d346df33391d",
}


def test_a_trial_starts_from_the_runs_of_a_grid_with_one_point(tmp_path: Path) -> None:
    search = {"space": {"tac.lr": {"float": [1e-4, 1e-2]}}, "trials": 2}
    stages = [
        PRETRAIN | {"grid": {"tac.alpha": [0.05]}},
        {k: v for k, v in FINETUNE.items() if k != "grid"} | {"search": search},
    ]
    sweep = plan(tmp_path, stages=stages)
    (run,) = sweep.add_trial("finetune", 0, {"tac.lr": 0.001}, [0], "trial0")
    source = sweep.node(str(sweep.node(run.key).source_key))
    assert source.run.tac.alpha == 0.05
    assert [node.label for node in sweep.nodes if node.stage == "pretrain"] == [source.label]
    assert len([one for one in sweep.runs if one.stage == "pretrain"]) == 1


def test_a_search_two_stages_after_a_grid_is_refused(tmp_path: Path) -> None:
    search = {"space": {"tac.lr": {"float": [1e-4, 1e-2]}}, "trials": 2}
    far = {"name": "far", "variant": "music-r", "init_from": "finetune", "search": search}
    pretrain = PRETRAIN | {"grid": {"tac.entropic_index": [1.0, 2.0]}}
    finetune = {k: v for k, v in FINETUNE.items() if k != "grid"}
    with pytest.raises(ConfigError, match=r"must lead to stages without a grid .* got 'pretrain'"):
        plan(tmp_path, stages=[pretrain, finetune, far])


def test_labels_of_close_values_differ(tmp_path: Path) -> None:
    values = [0.1234567, 0.1234568, 0.1, 1e-05, 1.0, 0.1 + 0.2]
    stage = {"name": "train", "variant": "tac", "grid": {"tac.tau": values}}
    document = {"name": "g", "tasks": ["FetchReach"], "seeds": [0], "stages": [stage]}
    labels = [node.label for node in make_plan(loaded(tmp_path, document)).nodes]
    shown = [label.split("=")[1].partition("/")[0] for label in labels]
    assert shown == ["0.1234567", "0.1234568", "0.1", "1e-05", "1", "0.3"]
