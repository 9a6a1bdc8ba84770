"""Writes docs/results.md, its appendix and their figures from the runs in docs/results/data alone.

python docs/generate_results.py            # writes them
python docs/generate_results.py --check    # exit code 1 where a page is out of date

The pages' words are in docs/results/page.md and appendix.md. Where they say `{{ KIND NAME }}`, a
table is put of the sweep NAME: of all of its runs that any export in docs/results/data has,
whichever sweep computed them, if tune_configs has a sweep of that name, and else of the export
docs/results/data/NAME. KIND is

- of a planned study: `verdict`, with the hypothesis, `answer`, `outcomes`, with stages, `seeds`,
  `cells`, `figure`, with the name of one, `hours` or `progress` of its runs;
- of any sweep: `runs`, `provenance`, `success`, `stages`, `curves`, `races` or `effects`, with
  stages behind NAME if not all are meant, `metric`, with metrics, or `search`.

    python -m music_rllib.report results/NAME --export docs/results/data/NAME --add
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from music_rllib import names
from music_rllib.config.load import load_sweep
from music_rllib.config.schema import SweepConfig
from music_rllib.experiment.plan import make_plan
from music_rllib.report.figures.choice import (
    PRIMARY,
    Drawing,
    drawings_of_stages,
    slug,
    stage_drawings,
)
from music_rllib.report.figures.draw import files
from music_rllib.report.search_tables import search_in_words, search_tables
from music_rllib.report.study import study_drawings
from music_rllib.results import statistics as st
from music_rllib.results.analysis import THRESHOLDS, StageAnalysis, analyse
from music_rllib.results.archive.folder import is_archive, read_archive
from music_rllib.results.archive.merge import of_plan
from music_rllib.results.claims.answer import answer
from music_rllib.results.claims.contrasts import Verdict
from music_rllib.results.claims.plan import analysis_plan
from music_rllib.results.claims.study import Mean, label_of, study_of
from music_rllib.results.comparison import Final, each_seed, p_text, verdict
from music_rllib.results.comparison import number as in_short
from music_rllib.results.conditions import Condition, Stage, find_stages
from music_rllib.results.data import Sweep
from music_rllib.results.time_to_threshold import (
    first_passage,
    median_wait,
    median_wait_interval,
    races,
    waits_of,
)

FOLDER = Path(__file__).parent
PAGES = {"results.md": "page.md", "results_appendix.md": "appendix.md"}
DATA, FIGURES = FOLDER / "results" / "data", FOLDER / "results" / "figures"
CONFIGS = FOLDER.parent / "tune_configs"
THRESHOLD = 0.9
NOTICE = "<!-- Written by docs/generate_results.py from docs/results/{} and docs/results/data. -->"
EARLIER = ("2",)
"""Versions of the algorithm whose runs are shown where there are none of a later one."""
NOT_RUN = "*Not run yet.*"


def main() -> int:
    """Writes the pages, or checks them."""
    figures: dict[str, bytes] = {}
    texts = {FOLDER / name: page(template, figures) for name, template in PAGES.items()}
    if "--check" in sys.argv[1:]:
        stale = [
            str(path)
            for path, text in texts.items()
            if not path.exists() or path.read_text("utf-8") != text
        ]
        if stale:
            names_of = ", ".join(stale)
            print(f"Out of date: {names_of}. python docs/generate_results.py", file=sys.stderr)
        return int(bool(stale))
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
    FIGURES.mkdir(parents=True, exist_ok=True)
    for old in FIGURES.glob("*.svg"):
        old.unlink()
    for name, content in figures.items():
        (FIGURES / name).write_bytes(content)
    return 0


def page(template: str, figures: dict[str, bytes]) -> str:
    """A template with its tables filled in; the figures that it shows go into `figures`."""
    tables: dict[str, Callable[..., Iterable[str]]] = {
        "answer": answer_text,
        "outcomes": outcomes_table,
        "seeds": seeds_table,
        "cells": cells,
        "figure": lambda sweep, name: named_figure(sweep, name, figures),
        "runs": runs_table,
        "provenance": lambda sweep: [provenance(sweep)],
        "success": lambda sweep, *stages: success(sweep, figures, stages),
        "stages": stages_table,
        "curves": lambda sweep, *stages: stage_curves(sweep, figures, stages),
        "races": races_table,
        "effects": effects_table,
        "metric": metric_table,
        "search": lambda sweep: search_text(sweep, figures),
    }

    def fill(match: re.Match[str]) -> str:
        kind, name, *rest = match[1].split()
        if kind == "verdict":
            return verdict_text(name, " ".join(rest))
        sweep = sweep_called(name)
        if kind == "hours":
            return f"{sum(run.seconds or 0.0 for run in sweep.runs) / 3600:.1f}" if sweep else "0"
        if kind == "progress":
            return "{} of {} runs".format(*progress(sweep)) if sweep else "not begun"
        return NOT_RUN if sweep is None else "\n".join(tables[kind](sweep, *rest))

    text = (FOLDER / "results" / template).read_text("utf-8")
    return f"{NOTICE.format(template)}\n\n{re.sub(r'{{ (.*?) }}', fill, text)}"


@cache
def sweep_called(name: str) -> Sweep | None:
    """What has been exported of a sweep's runs; None where nothing has."""
    config = config_of(name)
    if config is not None and not (plan := make_plan(config)).searched:
        earlier = [make_plan(config, algorithm=version) for version in EARLIER]
        return of_plan(plan, exports(), *earlier)
    return read_archive(DATA / name) if is_archive(DATA / name) else None


@cache
def config_of(name: str) -> SweepConfig | None:
    """The sweep of that name in tune_configs; None where there is none."""
    files = sorted(CONFIGS.glob("**/*.yaml"))
    found = (file for file in files if f"name: {name}\n" in file.read_text("utf-8"))
    file = next(found, None)
    return load_sweep(file) if file else None


@cache
def exports() -> list[Sweep]:
    """All that there are."""
    return [read_archive(folder) for folder in sorted(DATA.iterdir()) if is_archive(folder)]


# -- every run ----------------------------------------------------------------------------------


def runs_table(sweep: Sweep) -> Iterator[str]:
    """Each run, failures too: how far, how well, how long, under which code."""
    yield _row(
        "run", "state", "env steps", "last evaluation", f"first >= {_percent(THRESHOLD)} at", "time"
    )
    yield _rule(6)
    for position in sorted(range(len(sweep.runs)), key=lambda i: _natural(sweep.runs[i].name)):
        run = sweep.runs[position]
        steps, values = sweep.series(position, names.EVAL_SUCCESS)
        passage = first_passage(steps.astype(float), values, THRESHOLD)
        yield _row(
            f"`{run.name}`",
            run.status.lower(),
            f"{sweep.last_step(position):,}",
            _last(sweep, position),
            _first(passage),
            _clock(run.seconds),
        )
    yield ""
    yield provenance(sweep)


def _last(sweep: Sweep, run: int) -> str:
    """What its task is judged by, at the end; empty before the first evaluation."""
    metric = sweep.primary_metric(sweep.runs[run].task)
    value = sweep.final(run, metric)
    if value is None:
        return ""
    return _percent(value) if metric == names.EVAL_SUCCESS else in_short(value)


def _first(passage: tuple[float, bool] | None) -> str:
    """The step of a first passage; empty where the task has no success rate."""
    if passage is None:
        return ""
    steps, reached = passage
    return f"{steps:,.0f}" if reached else "not"


def provenance(sweep: Sweep) -> str:
    """Commits, versions and the evaluation's size that the runs were made with."""
    commits = _all_of(run.tags.get(names.TAG_GIT_COMMIT, "")[:7] for run in sweep.runs)
    versions = sorted(
        {
            f"{tag.removeprefix(names.TAG_VERSION_PREFIX)} {value}"
            for run in sweep.runs
            for tag, value in run.tags.items()
            if tag.startswith(names.TAG_VERSION_PREFIX) and tag != names.TAG_ALGORITHM
        }
    )
    episodes = _all_of(run.params.get("evaluation.episodes", "") for run in sweep.runs)
    algorithm = _all_of(run.tags.get(names.TAG_ALGORITHM, EARLIER[0]) for run in sweep.runs)
    return (
        f"{episodes} evaluation episodes; algorithm {algorithm}; commit {commits}; "
        f"{', '.join(versions)}."
    )


# -- success rates -------------------------------------------------------------------------------


def success(sweep: Sweep, figures: dict[str, bytes], stages: Sequence[str] = ()) -> Iterator[str]:
    """Per stage: final success and steps to the threshold, what may be said, and the curves."""
    for analysis in analyse(sweep):
        if stages and analysis.stage.name not in stages:
            continue
        yield from success_table(sweep, analysis)
        yield ""
        for scope in analysis.scopes:
            yield " ".join(verdict(scope))
            yield ""
        yield from curves(sweep, analysis, figures)


def success_table(sweep: Sweep, analysis: StageAnalysis) -> Iterator[str]:
    """One row per task and condition."""
    yield _row("task", f"{analysis.stage.variant}", *_OUTCOME)
    yield _rule(2 + len(_OUTCOME))
    for task in analysis.stage.tasks:
        for condition, cells in outcomes(sweep, analysis, task):
            yield _row(task, condition.label, *cells)


def stages_table(sweep: Sweep, *stages: str) -> Iterator[str]:
    """One row per task, stage and condition: stages side by side."""
    yield _row("task", "stage", "condition", *_OUTCOME)
    yield _rule(3 + len(_OUTCOME))
    for analysis in analyse(sweep):
        if not stages or analysis.stage.name in stages:
            for task in analysis.stage.tasks:
                for condition, cells in outcomes(sweep, analysis, task):
                    yield _row(task, analysis.stage.name, condition.label, *cells)


_OUTCOME = (
    "finished",
    "success, last evaluation: mean [95 %]",
    "each seed, %",
    f"steps to {100 * THRESHOLD:.0f} %: median [95 %]",
    "each run",
)


def outcomes(
    sweep: Sweep, analysis: StageAnalysis, task: str
) -> Iterator[tuple[Condition, tuple[str, ...]]]:
    """Each condition with a run of the task, and what `_OUTCOME` names."""
    (scope,) = [scope for scope in analysis.scopes if scope.name == task]
    finals = {final.condition: final for final in scope.finals}
    for condition in analysis.stage.conditions:
        runs = [i for i in condition.runs if sweep.runs[i].task == task]
        if runs:
            done = sum(sweep.runs[i].status == "FINISHED" for i in runs)
            yield (
                condition,
                (
                    f"{done} of {len(runs)}",
                    *_interval(finals.get(condition)),
                    *waits(sweep, task, runs),
                ),
            )


def waits(sweep: Sweep, task: str, runs: Sequence[int]) -> tuple[str, str]:
    """Median of the steps to the threshold, censored where it was not reached, and each run's."""
    told = waits_of(sweep, task, runs, THRESHOLD)
    if told is None:
        return "", ""
    each = ", ".join(
        f"{'' if there else '> '}{steps:,.0f}"
        for steps, there in sorted(zip(told.steps, told.reached, strict=True))
    )
    if not told.reached.any():
        return "not reached", each
    return _wait_text(median_wait(told), *median_wait_interval(told)), each


def curves(sweep: Sweep, analysis: StageAnalysis, figures: dict[str, bytes]) -> Iterator[str]:
    """The figure of success rates."""
    for drawing in stage_drawings(sweep, analysis):
        if drawing.title == "Success rate":
            yield from figure(sweep, drawing, figures)
            yield ""


def stage_curves(sweep: Sweep, figures: dict[str, bytes], stages: Sequence[str]) -> Iterator[str]:
    """The figure of success rates of several stages."""
    for drawing in drawings_of_stages(sweep, _some(sweep, stages)):
        if drawing.title in PRIMARY:
            yield from figure(sweep, drawing, figures)


def figure(sweep: Sweep, drawing: Drawing, figures: dict[str, bytes]) -> Iterator[str]:
    """Puts the drawing into `figures` and shows it."""
    name = f"{slug(sweep.name)}-{drawing.name}.svg"
    figures[name] = files(drawing.panels, drawing.legend)[".svg"]
    yield f"![{drawing.title} of {sweep.name}, {drawing.stage}](results/figures/{name})"


def races_table(sweep: Sweep, *stages: str) -> Iterator[str]:
    """Who gets to the threshold sooner, each condition against each, also between stages."""
    groups: dict[str, Sequence[int]] = {}
    for stage in _some(sweep, stages):
        for condition in stage.conditions:
            several = len(stage.conditions) > 1
            name = f"{stage.name}, {condition.label}" if several else stage.name
            groups[name] = condition.runs
    yield from _races(sweep, lambda _: (groups,))


def effects_table(sweep: Sweep, *stages: str) -> Iterator[str]:
    """The same of each stage over q, and of each q over the stages.

    On each task over the q that all stages have there, and the stages that all q have: otherwise
    what differs would be the stage, too.
    """

    def questions(task: str) -> tuple[Groups, Groups]:
        cells: dict[tuple[str, str], list[int]] = {}
        for stage in _some(sweep, stages):
            for condition in stage.conditions:
                if there := [run for run in condition.runs if sweep.runs[run].task == task]:
                    cells.setdefault((stage.name, condition.entropic_index), []).extend(there)
        return (
            _balanced(cells, lambda stage, q: (stage, f"q = {q}")),
            _balanced(cells, lambda stage, q: (f"q = {q}", stage)),
        )

    yield from _races(sweep, questions)


Groups = dict[str, Sequence[int]]


def _balanced(
    cells: Mapping[tuple[str, str], Sequence[int]], name: Callable[[str, str], tuple[str, str]]
) -> Groups:
    """Runs by the first part of their cell's name, over those second parts that all first have."""
    by_group: dict[str, dict[str, Sequence[int]]] = {}
    for cell, runs in cells.items():
        group, part = name(*cell)
        by_group.setdefault(group, {})[part] = runs
    shared = [
        part
        for part in dict.fromkeys(part for parts in by_group.values() for part in parts)
        if all(part in parts for parts in by_group.values())
    ]
    over = ", ".join(shared)
    return {
        f"{group} ({over})": [run for part in shared for run in parts[part]]
        for group, parts in by_group.items()
        if shared
    }


def _some(sweep: Sweep, stages: Sequence[str]) -> list[Stage]:
    return [stage for stage in find_stages(sweep) if not stages or stage.name in stages]


def _races(sweep: Sweep, questions: Callable[[str], Iterable[Groups]]) -> Iterator[str]:
    """On each task, of each question all pairs of its groups, corrected for their number."""
    yield _row("task", "sooner at", "than", "runs", "probability [95 %]", "p", "decided")
    yield _rule(7)
    for task in dict.fromkeys(run.task for run in sweep.runs):
        for groups in questions(task):
            for race in races(sweep, task, groups, THRESHOLD):
                yield _row(
                    race.task,
                    race.first,
                    race.second,
                    " / ".join(map(str, race.runs)),
                    _spread(race.estimate) if race.reached else "not reached by either",
                    f"{race.p_value:.2g}" if race.reached else "",
                    "yes" if race.decided else "no",
                )


# -- other metrics ------------------------------------------------------------------------------


def metric_table(sweep: Sweep, *metrics: str) -> Iterator[str]:
    """Last values of metrics, run by run, and their mean with its interval."""
    for position, analysis in enumerate(analyse(sweep)):
        if position:
            yield ""
        seeds = analysis.stage.seeds
        yield _row(
            "task", "condition", "metric", *(f"seed {seed}" for seed in seeds), "mean [95 %]"
        )
        yield _rule(len(seeds) + 4)
        for task in analysis.stage.tasks:
            for condition in analysis.stage.conditions:
                runs = {sweep.runs[i].seed: i for i in condition.runs if sweep.runs[i].task == task}
                for metric in metrics:
                    last = [last_value(sweep, runs.get(seed), metric) for seed in seeds]
                    episodes = sweep.episodes(runs.values()) if metric in names.EVAL_RATES else None
                    told = st.estimate(np.array(last)[:, np.newaxis], episodes)
                    numbers = [in_short(value) if np.isfinite(value) else "" for value in last]
                    yield _row(task, condition.label, f"`{metric}`", *numbers, _spread(told))


def last_value(sweep: Sweep, run: int | None, metric: str) -> float:
    """Of a finished run; NaN otherwise."""
    if run is None or sweep.runs[run].status != "FINISHED":
        return float("nan")
    value = sweep.final(run, metric)
    return float("nan") if value is None else value


# -- planned studies -----------------------------------------------------------------------------


def verdict_text(name: str, hypothesis: str) -> str:
    """What a study says of a hypothesis of its plan; nothing before all of its runs have finished.

    Raises:
        ValueError: if its plan has no such hypothesis.
    """
    config = config_of(name)
    plan = analysis_plan(config) if config else None
    if plan is None or hypothesis not in plan.hypotheses:
        raise ValueError(f"{name} has no hypothesis {hypothesis!r}")
    sweep = sweep_called(name)
    if sweep is None:
        return "not begun"
    finished, planned = progress(sweep)
    if finished < planned:
        return f"under way: {finished} of {planned} runs"
    claims = {claim.hypothesis.text: claim for claim in study_of(sweep).planned if claim.hypothesis}
    claim = claims[hypothesis]
    tested = claim.p_value
    if claim.verdict is Verdict.EQUIVALENT and claim.p_equivalent is not None:
        tested = claim.p_equivalent
    difference = _signed(claim.contrast.difference)
    return f"**{claim.verdict}**: {difference}; {p_text(tested)}; {claim.contrast.seeds[0]} seeds"


def answer_text(sweep: Sweep) -> Iterator[str]:
    """A study's answer; before all of its runs have finished only how far it is."""
    finished, planned = progress(sweep)
    yield f"**{finished} of {planned} planned runs have finished.**"
    if finished == planned:
        yield ""
        yield from (f"- {sentence}" for sentence in answer(sweep, study_of(sweep)))


def progress(sweep: Sweep) -> tuple[int, int]:
    """Runs that have finished, and those that the sweep's file plans."""
    config = config_of(sweep.name)
    planned = len(make_plan(config).nodes) if config else len(sweep.runs)
    return sum(run.status == "FINISHED" for run in sweep.runs), planned


def outcomes_table(sweep: Sweep, *stages: str) -> Iterator[str]:
    """One column per condition: what was planned to be counted, and below it what was not."""
    rates = (f"steps to {_percent(rate)}: median [95 %]" for rate in THRESHOLDS)
    columns = [
        [
            "",
            "**area under the curve: mean [95 %]**",
            "success at the end: mean [95 %]",
            *rates,
            "Shannon entropy at the end, nats",
            "S_q at the end",
            "seeds",
        ]
    ]
    for analysis in analyse(sweep):
        if analysis.stage.name in stages:
            prefix = f"{analysis.stage.name}, " if len(stages) > 1 else ""
            means = study_of(sweep, analysis.stage.name).means
            columns += [list(_outcomes(analysis, mean, prefix)) for mean in means]
    header, *rows = zip(*columns, strict=True)
    yield _row(*header)
    yield _rule(len(header))
    yield from (_row(*row) for row in rows)


def _outcomes(analysis: StageAnalysis, mean: Mean, prefix: str) -> Iterator[str]:
    key = (mean.condition, mean.task)
    (final,) = (
        final
        for scope in analysis.scopes
        for final in scope.finals
        if (final.condition, scope.name) == key
    )
    yield f"{prefix}{label_of(mean.condition)}"
    yield _spread(mean.estimate)
    yield _interval(final)[0]
    for wait in analysis.waits:
        if (wait.condition, wait.task) == key:
            yield _wait_text(wait.median, wait.lower, wait.upper)
    for entropy in analysis.entropies[mean.task, mean.condition]:
        yield _spread(entropy) if entropy else ""
    yield f"{len(mean.scores.by_seed)} of {mean.runs}"


def seeds_table(sweep: Sweep) -> Iterator[str]:
    """The area under the curve of every seed."""
    means = study_of(sweep).means
    yield _row("seed", *(label_of(mean.condition) for mean in means))
    yield _rule(1 + len(means))
    for seed in sorted({seed for mean in means for seed in mean.scores.by_seed}, key=int):
        scores = (mean.scores.by_seed.get(seed) for mean in means)
        yield _row(seed, *("" if score is None else f"{score:.3f}" for score in scores))


def cells(sweep: Sweep) -> Iterator[str]:
    """A row for each α and a column for each q: area under the curve, entropy at the end, seeds."""
    means = study_of(sweep).means
    by_cell = {(mean.condition.entropic_index, alpha_of(sweep, mean)): mean for mean in means}
    qs, alphas = (sorted({cell[i] for cell in by_cell}, key=float) for i in (0, 1))
    yield _row("α", *(f"q = {q}" for q in qs))
    yield _rule(1 + len(qs))
    for alpha in alphas:
        yield _row(alpha, *(cell_text(sweep, by_cell.get((q, alpha))) for q in qs))


def alpha_of(sweep: Sweep, mean: Mean) -> str:
    """Of a condition's runs."""
    return sweep.runs[mean.condition.runs[0]].tags[names.TAG_ALPHA]


def cell_text(sweep: Sweep, mean: Mean | None) -> str:
    """`0.21 ± 0.03, 1.4 nats (5)`; the spread is the standard deviation over seeds."""
    if mean is None or not mean.scores.by_seed:
        return ""
    scores = list(mean.scores.by_seed.values())
    runs = [run for run in mean.condition.runs if sweep.runs[run].status == "FINISHED"]
    entropy = np.mean([last_value(sweep, run, names.SHANNON_ENTROPY) for run in runs])
    spread = f" ± {np.std(scores, ddof=1):.2f}" if len(scores) > 1 else ""
    return f"{np.mean(scores):.2f}{spread}, {entropy:.1f} nats ({len(scores)})"


def named_figure(sweep: Sweep, name: str, figures: dict[str, bytes]) -> Iterator[str]:
    """The figure of that name, of the stage that is compared.

    Raises:
        ValueError: if there is none.
    """
    study = study_of(sweep)
    stages = [
        found for found in analyse(sweep) if study.stage and found.stage.name == study.stage.name
    ]
    drawings = [d for found in stages for d in stage_drawings(sweep, found)]
    named = {slug(d.title): d for d in (*drawings, *study_drawings(study))}
    if name not in named:
        raise ValueError(f"{sweep.name} has no figure {name}, but {', '.join(named)}")
    yield from figure(sweep, named[name], figures)


# -- searches ------------------------------------------------------------------------------------


def search_text(sweep: Sweep, figures: dict[str, bytes]) -> Iterator[str]:
    """How it searched, its ranking on fresh seeds, importances, trials, and what may be said."""
    analyses = {found.stage.name: found for found in analyse(sweep)}
    for search in sweep.searches:
        yield search_in_words(search)
        for scope in analyses[search["stage"]].scopes:
            yield f"\n{' '.join(verdict(scope))}"
        for found in search_tables(search):
            yield f"\n**{found.title}.** {found.note}\n"
            yield _row(*found.header)
            yield _rule(len(found.header))
            yield from (_row(*row) for row in found.rows)
        yield ""
        for drawing in stage_drawings(sweep, analyses[search["stage"]]):
            if drawing.title == "Importance of settings":
                yield from figure(sweep, drawing, figures)
                yield ""
    yield provenance(sweep)


# -- words ---------------------------------------------------------------------------------------


def _row(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def _rule(columns: int) -> str:
    return "|" + "---|" * columns


def _interval(final: Final[Condition] | None) -> tuple[str, str]:
    if final is None:
        return "", ""
    found = final.estimate
    value, each = _percent(final.value), ", ".join(f"{100 * x:.0f}" for x in each_seed(final))
    if not found.has_interval:
        return f"{value} (one seed)", each
    return f"{value} [{_percent(float(found.lower))}, {_percent(float(found.upper))}]", each


def _spread(found: st.Estimate) -> str:
    if not np.isfinite(found.value):
        return ""
    value, lower, upper = (in_short(float(x)) for x in (found.value, found.lower, found.upper))
    return f"{value} [{lower}, {upper}]" if found.has_interval else value


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _signed(found: st.Estimate) -> str:
    """`-0.07 (95 % -0.10 to -0.04)`."""
    value, lower, upper = (float(x) for x in (found.value, found.lower, found.upper))
    return f"{value:+.2f} (95 % {lower:.2f} to {upper:.2f})"


def _wait_text(median: float, low: float, high: float) -> str:
    spread = "" if np.isnan(low) else f" [{_steps_text(low)}, {_steps_text(high)}]"
    return f"{_steps_text(median)}{spread}"


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
