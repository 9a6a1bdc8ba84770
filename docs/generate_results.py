"""Writes docs/results.md and its figures from the runs in docs/results/data, and nothing else.

python docs/generate_results.py            # writes them
python docs/generate_results.py --check    # exit code 1 where the page is out of date

The page's words are in docs/results/page.md. Where that says `{{ runs NAME }}`,
`{{ success NAME }}` or `{{ metric NAME METRIC }}`, a table is put of the sweep that is exported to
docs/results/data/NAME:

    python -m music_rllib.report results/NAME --export docs/results/data/NAME --add
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from music_rllib.reports import statistics as st
from music_rllib.reports.analysis import Final, StageAnalysis, analyse
from music_rllib.reports.archive import is_archive, read_archive
from music_rllib.reports.data import Sweep
from music_rllib.reports.figures import files
from music_rllib.reports.gallery import slug, stage_drawings
from music_rllib.reports.survival import Waits, first_passage, median_wait, median_wait_interval
from music_rllib.reports.verdict import verdict
from music_rllib.tracking import names

FOLDER = Path(__file__).parent
PAGE, TEMPLATE = FOLDER / "results.md", FOLDER / "results" / "page.md"
DATA, FIGURES = FOLDER / "results" / "data", FOLDER / "results" / "figures"
THRESHOLD = 0.9
DIFFERENCE = 0.1
"""In success rate, which a reader would want to see: how many seeds would likely show it?"""
NOTICE = (
    "<!-- Written by docs/generate_results.py from docs/results/page.md and docs/results/data. -->"
)
NOT_RUN = "*Not run yet.*"


def main() -> int:
    """Writes the page, or checks it."""
    figures: dict[str, bytes] = {}
    text = page(figures)
    if "--check" in sys.argv[1:]:
        current = PAGE.read_text("utf-8") if PAGE.exists() else ""
        if current != text:
            print(f"{PAGE} is out of date: python docs/generate_results.py", file=sys.stderr)
        return int(current != text)
    PAGE.write_text(text, encoding="utf-8")
    FIGURES.mkdir(parents=True, exist_ok=True)
    for name, content in figures.items():
        (FIGURES / name).write_bytes(content)
    return 0


def page(figures: dict[str, bytes]) -> str:
    """The template with its tables filled in; the figures that it shows go into `figures`."""
    tables: dict[str, Callable[..., Iterable[str]]] = {
        "runs": runs_table,
        "success": lambda sweep: success(sweep, figures),
        "metric": metric_table,
    }

    def fill(match: re.Match[str]) -> str:
        kind, name, *rest = match[1].split()
        if not is_archive(DATA / name):
            return NOT_RUN
        return "\n".join(tables[kind](read_archive(DATA / name), *rest))

    template = TEMPLATE.read_text("utf-8")
    return f"{NOTICE}\n\n{re.sub(r'{{ (.*?) }}', fill, template)}"


# -- every run ----------------------------------------------------------------------------------


def runs_table(sweep: Sweep) -> Iterator[str]:
    """Each run, failures too: how far, how well, how long, under which code."""
    yield _row("run", "state", "env steps", "success", f"first >= {_percent(THRESHOLD)} at", "time")
    yield _rule(6)
    for position in sorted(range(len(sweep.runs)), key=lambda i: _natural(sweep.runs[i].name)):
        run = sweep.runs[position]
        steps, values = sweep.series(position, names.EVAL_SUCCESS)
        passage = first_passage(steps.astype(float), values, THRESHOLD)
        yield _row(
            f"`{run.name}`",
            run.status.lower(),
            f"{sweep.last_step(position):,}",
            _percent(values[-1]) if len(values) else "",
            f"{passage[0]:,.0f}" if passage and passage[1] else "not",
            _clock(run.seconds),
        )
    yield ""
    yield provenance(sweep)


def provenance(sweep: Sweep) -> str:
    """Commits, versions and the evaluation's size that the runs were made with."""
    commits = _all_of(run.tags.get(names.TAG_GIT_COMMIT, "")[:7] for run in sweep.runs)
    versions = sorted(
        {
            f"{tag.removeprefix(names.TAG_VERSION_PREFIX)} {value}"
            for run in sweep.runs
            for tag, value in run.tags.items()
            if tag.startswith(names.TAG_VERSION_PREFIX)
        }
    )
    episodes = _all_of(run.params.get("evaluation.episodes", "") for run in sweep.runs)
    return f"{episodes} evaluation episodes; commit {commits}; {', '.join(versions)}."


# -- success rates -------------------------------------------------------------------------------


def success(sweep: Sweep, figures: dict[str, bytes]) -> Iterator[str]:
    """Per stage: final success and steps to the threshold, what may be said, and the curves."""
    rng = np.random.default_rng(0)
    for analysis in analyse(sweep, rng):
        yield from success_table(sweep, analysis, rng)
        yield ""
        for scope in analysis.scopes:
            yield " ".join(verdict(scope, DIFFERENCE))
            yield ""
        yield from curves(sweep, analysis, rng, figures)


def success_table(sweep: Sweep, analysis: StageAnalysis, rng: np.random.Generator) -> Iterator[str]:
    """One row per task and condition."""
    yield _row(
        "task",
        f"{analysis.stage.variant}",
        "finished",
        "success, last evaluation: IQM [95 %]",
        f"steps to {_percent(THRESHOLD)}: median [95 %]",
        "got there",
    )
    yield _rule(6)
    for task in analysis.stage.tasks:
        (scope,) = [scope for scope in analysis.scopes if scope.name == task]
        finals = {final.condition: final for final in scope.finals}
        for condition in analysis.stage.conditions:
            runs = [i for i in condition.runs if sweep.runs[i].task == task]
            if runs:
                done = sum(sweep.runs[i].status == "FINISHED" for i in runs)
                yield _row(
                    task,
                    condition.label,
                    f"{done} of {len(runs)}",
                    _interval(finals.get(condition)),
                    *waits(sweep, runs, rng),
                )


def waits(sweep: Sweep, runs: Sequence[int], rng: np.random.Generator) -> tuple[str, str]:
    """Steps to the threshold, censored where it was not reached, and how many reached it."""
    found = [sweep.series(i, names.EVAL_SUCCESS) for i in runs]
    passages = [first_passage(steps.astype(float), v, THRESHOLD) for steps, v in found]
    there = [passage for passage in passages if passage]
    if not there:
        return "", ""
    told = Waits(
        steps=np.array([steps for steps, _ in there]),
        reached=np.array([reached for _, reached in there]),
    )
    low, high = median_wait_interval(told, rng)
    spread = "" if np.isnan(low) else f" [{_steps_text(low)}, {_steps_text(high)}]"
    return (
        f"{_steps_text(median_wait(told))}{spread}",
        f"{int(told.reached.sum())} of {len(there)}",
    )


def curves(
    sweep: Sweep, analysis: StageAnalysis, rng: np.random.Generator, figures: dict[str, bytes]
) -> Iterator[str]:
    """The figure of success rates."""
    for drawing in stage_drawings(sweep, analysis, rng):
        if drawing.title == "Success rate":
            name = f"{slug(sweep.name)}-{drawing.name}.svg"
            figures[name] = files(drawing.panels, drawing.legend)["svg"]
            described = f"{drawing.title} of {sweep.name}, {analysis.stage.name}"
            yield f"![{described}](results/figures/{name})"
            yield ""


# -- other metrics ------------------------------------------------------------------------------


def metric_table(sweep: Sweep, *metrics: str) -> Iterator[str]:
    """Last values of metrics, run by run, and their interquartile mean with its interval."""
    rng = np.random.default_rng(0)
    for analysis in analyse(sweep, rng):
        seeds = analysis.stage.seeds
        yield _row("task", "condition", "metric", *(f"seed {seed}" for seed in seeds), "IQM [95 %]")
        yield _rule(len(seeds) + 4)
        for task in analysis.stage.tasks:
            for condition in analysis.stage.conditions:
                runs = {sweep.runs[i].seed: i for i in condition.runs if sweep.runs[i].task == task}
                for metric in metrics:
                    last = [last_value(sweep, runs.get(seed), metric) for seed in seeds]
                    told = st.estimate(np.array(last)[:, np.newaxis], rng)
                    numbers = [f"{value:.2f}" if np.isfinite(value) else "" for value in last]
                    yield _row(task, condition.label, f"`{metric}`", *numbers, _spread(told))


def last_value(sweep: Sweep, run: int | None, metric: str) -> float:
    """Of a finished run; NaN otherwise."""
    if run is None or sweep.runs[run].status != "FINISHED":
        return float("nan")
    _, values = sweep.series(run, metric)
    return float(values[-1]) if len(values) else float("nan")


# -- words ---------------------------------------------------------------------------------------


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _rule(columns: int) -> str:
    return "|" + "---|" * columns


def _interval(final: Final | None) -> str:
    if final is None:
        return ""
    found = final.estimate
    value = _percent(float(found.value))
    if not found.has_interval:
        return f"{value} (one seed)"
    return f"{value} [{_percent(float(found.lower))}, {_percent(float(found.upper))}]"


def _spread(found: st.Estimate) -> str:
    if not np.isfinite(found.value):
        return ""
    if not found.has_interval:
        return f"{float(found.value):.2f}"
    return f"{float(found.value):.2f} [{float(found.lower):.2f}, {float(found.upper):.2f}]"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _steps_text(steps: float) -> str:
    return f"{steps:,.0f}" if np.isfinite(steps) else "not reached"


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02}"


def _all_of(values: Iterable[str]) -> str:
    return ", ".join(f"`{value}`" for value in sorted(set(values) - {""}))


def _natural(name: str) -> list[tuple[int, int | str]]:
    """Sorts seed10 after seed9."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts]


if __name__ == "__main__":
    sys.exit(main())
