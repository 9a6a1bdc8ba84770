"""Short labels of runs: each matches one run."""

import itertools

import pytest

from music_rllib.names import ShortLabels, label_matches, symbol

LABEL = "finetune/FetchPush/pretrain:tac.alpha=0.1,tac.entropic_index=1.5,tac.tau=0.05/seed0"


@pytest.mark.parametrize(
    ("wanted", "meant"),
    [
        (LABEL, True),
        ("finetune/q=1.5/FetchPush/seed=0", True),
        ("q=1.5/seed0", True),
        ("q=1.50,tau=5e-2", True),
        ("tau=0.05/seed0", True),
        ("tac.tau=0.05", True),
        ("q=1.5/seed01", False),
        ("q=1/seed0", False),
        ("q=15/seed0", False),
        ("pretrain/seed0", False),
        ("alpha=0.1", True),
        ("seed", False),
        ("tune", False),
    ],
)
def test_parts_of_a_label_in_any_order(wanted: str, meant: bool) -> None:
    assert label_matches(wanted, LABEL) is meant


@pytest.mark.parametrize("stages", [["a"], ["a", "b"]])
@pytest.mark.parametrize("tasks", [["FetchPush"], ["FetchPush", "FetchSlide"]])
def test_a_short_label_matches_one_run(stages: list[str], tasks: list[str]) -> None:
    values = ["tac.entropic_index=1", "tac.entropic_index=1.5", "music.reward_scale=1,tac.tau=0.5"]
    cells = itertools.product(stages, tasks, values, ["seed0", "seed1", "seed10"])
    labels = ["/".join(cell) for cell in cells]
    short = ShortLabels.of(labels)
    for label in labels:
        assert [other for other in labels if label_matches(short(label), other)] == [label]
    assert len(short(labels[0]).split("/")) == 2 + (len(stages) > 1) + (len(tasks) > 1)
    assert "q=1/" in short(labels[0])


def test_other_text_is_not_shortened() -> None:
    short = ShortLabels(["a"], ["FetchPush"])
    assert short("a/FetchPush/seed0") == "seed0"
    assert short("handoff /somewhere/else") == "handoff /somewhere/else"
    assert short("a/FetchPush/trial7/tac.entropic_index={schedule:linear,start:1,end:2}/seed0") == (
        "trial7/q={schedule:linear,start:1,end:2}/seed0"
    )


def test_settings_have_the_symbols_of_labels() -> None:
    named = {"tac.entropic_index": "q", "tac.alpha": "alpha", "env_steps": "env_steps"}
    named |= {"pretrain:tac.entropic_index": "pretrain:q", "music.mi_reward_weight": "weight"}
    assert {setting: symbol(setting) for setting in named} == named
