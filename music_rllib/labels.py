"""Short labels of runs: `q=1.5/seed0` in a sweep with one stage and one task.

A complete label is `finetune/FetchPush/tac.entropic_index=1.5,tac.alpha=0.1/seed0`: stage, task,
the settings in which the trial differs from others, seed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

SYMBOLS = {"q": "entropic_index", "weight": "mi_reward_weight"}
"""Short name of a setting in papers, tables and labels to its name."""
_NAME = re.compile(r"(?<![\w.])(?:(?:tac|music|replay|evaluation)\.)?(\w+)(?==)")
_ITEM = re.compile(r",(?=[\w:.-]+=)")


def in_runs(number: int) -> str:
    """A number of runs in text: `1 run`, `2 runs`."""
    return "1 run" if number == 1 else f"{number} runs"


class ShortLabels:
    """Shortens labels of a sweep: omits a stage or task that all runs have, uses symbols."""

    def __init__(self, stages: Iterable[str], tasks: Iterable[str]) -> None:
        self._stages, self._tasks = set(stages), set(tasks)

    @classmethod
    def of(cls, labels: Iterable[str]) -> ShortLabels:
        """Create it for a sweep whose runs have these labels."""
        parts = [label.split("/") for label in labels]
        return cls((part[0] for part in parts), (part[1] for part in parts if len(part) > 1))

    def __call__(self, label: str) -> str:
        """The short form of `label`; other text is returned unchanged."""
        stage, _, rest = label.partition("/")
        task, _, rest = rest.partition("/")
        if stage not in self._stages or task not in self._tasks or not rest:
            return label
        kept = [stage] * (len(self._stages) > 1) + [task] * (len(self._tasks) > 1)
        return "/".join((*kept, _NAME.sub(_symbol, rest)))


def symbol(setting: str) -> str:
    """The short form of a setting: `q` for `tac.entropic_index`, `alpha` for `tac.alpha`."""
    return _NAME.sub(_symbol, f"{setting}=").removesuffix("=")


def _symbol(match: re.Match[str]) -> str:
    return next((symbol for symbol, name in SYMBOLS.items() if name == match[1]), match[1])


def label_matches(wanted: str, label: str) -> bool:
    """Whether every part of `wanted`, short or complete, is a part of `label`, in any order."""
    parts = [_items(part) for part in label.split("/")]
    return all(
        any(all(any(_same(item, other) for other in part) for item in given) for part in parts)
        for given in map(_items, wanted.strip("/").split("/"))
    )


def _items(part: str) -> list[tuple[str, str]]:
    """Names and values of `tac.lr=0.1,q=2`; `FetchPush` and `seed0` are names without values."""
    pairs = [item.partition("=")[::2] for item in _ITEM.split(part)]
    return [(f"seed{value}", "") if name == "seed" else (name, value) for name, value in pairs]


def _same(given: tuple[str, str], item: tuple[str, str]) -> bool:
    """Whether a given name and value equal those of a label's item."""
    name = SYMBOLS.get(given[0], given[0])
    if name != item[0] and not item[0].endswith((f".{name}", f":{name}")):
        return False
    return given[1] == item[1] or _number(given[1]) == _number(item[1]) is not None


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
