"""Labels of runs as people say them: `q=1.5/seed0` for a run of a sweep with one stage and task.

A run's whole label is `finetune/FetchPush/tac.entropic_index=1.5,tac.alpha=0.1/seed0`: its stage,
task, the values that tell its trial apart, its seed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

SYMBOLS = {"q": "entropic_index", "weight": "mi_reward_weight"}
"""What papers, tables and labels call a setting to its name."""
_NAME = re.compile(r"(?<![\w.])(?:(?:tac|music|replay|evaluation)\.)?(\w+)(?==)")
_ITEM = re.compile(r",(?=[\w:.-]+=)")


def in_runs(number: int) -> str:
    """`1 run`, `2 runs`."""
    return "1 run" if number == 1 else f"{number} runs"


class ShortLabels:
    """Labels without the stage and the task that all of a sweep's runs have in common."""

    def __init__(self, stages: Iterable[str], tasks: Iterable[str]) -> None:
        """Of a sweep with these stages and tasks."""
        self._stages, self._tasks = set(stages), set(tasks)

    @classmethod
    def of(cls, labels: Iterable[str]) -> ShortLabels:
        """Of a sweep whose runs have these labels."""
        parts = [label.split("/") for label in labels]
        return cls((part[0] for part in parts), (part[1] for part in parts if len(part) > 1))

    def __call__(self, label: str) -> str:
        """`label` in short; what is no label of the sweep stays as it is."""
        stage, _, rest = label.partition("/")
        task, _, rest = rest.partition("/")
        if stage not in self._stages or task not in self._tasks or not rest:
            return label
        kept = [stage] * (len(self._stages) > 1) + [task] * (len(self._tasks) > 1)
        return "/".join((*kept, _NAME.sub(_symbol, rest)))


def symbol(setting: str) -> str:
    """A setting as labels call it: `q` for `tac.entropic_index`, `alpha` for `tac.alpha`."""
    return _NAME.sub(_symbol, f"{setting}=").removesuffix("=")


def _symbol(found: re.Match[str]) -> str:
    name = found[1]
    return next((symbol for symbol, meant in SYMBOLS.items() if meant == name), name)


def is_meant(wanted: str, label: str) -> bool:
    """Whether `wanted` has parts of `label` only, in short or whole, in any order."""
    parts = [_items(part) for part in label.split("/")]
    return all(
        any(all(any(_same(item, other) for other in part) for item in given) for part in parts)
        for given in map(_items, wanted.strip("/").split("/"))
    )


def _items(part: str) -> list[tuple[str, str]]:
    """`tac.lr=0.1,q=2` as names and values; `FetchPush` and `seed0` as names alone."""
    found = []
    for item in _ITEM.split(part):
        name, _, value = item.partition("=")
        found.append((f"seed{value}", "") if name == "seed" else (name, value))
    return found


def _same(item: tuple[str, str], other: tuple[str, str]) -> bool:
    (name, value), (whole, its) = item, other
    name = SYMBOLS.get(name, name)
    if name != whole and not whole.endswith((f".{name}", f":{name}")):
        return False
    return value == its or _number(value) == _number(its) is not None


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
