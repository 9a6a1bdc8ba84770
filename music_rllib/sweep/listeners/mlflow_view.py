"""The view of MLflow's chart page that the link at the end of a sweep opens.

MLflow keeps the result of *Save view* as a tag of the experiment, and opens it by the tag's key
(`?viewStateShareKey=KEY`). The format is MLflow's own, as its pages of `VERSIONS` read it.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

from music_rllib import names
from music_rllib.config.schema import Stage
from music_rllib.experiment.plan import Plan
from music_rllib.redaction import flat_params
from music_rllib.results.conditions import IN_WORDS

VERSIONS = ("3.17", "3.18")
"""Versions of MLflow whose pages open such a view; others get a plain link."""
METRICS = (names.EVAL_RETURN, names.SHANNON_ENTROPY, names.ENTROPY, names.MI_BOUND)
"""Charts after those of the tasks' primary metrics."""
SECTION = "comparison"


def comparison_view(plan: Plan, stage: Stage, sweep_id: str, now: float) -> str:
    """The view of a stage: a line per condition, its primary metric first.

    `sweep_id` is the value of its runs' tag of this name, `now` is in seconds since the epoch.
    """
    tasks = stage.tasks
    metrics = list(dict.fromkeys((*(task.primary_metric for task in tasks), *METRICS)))
    varied = {name for node in plan.nodes if node.stage == stage.name for name in node.values}
    if stage.search is not None:  # none of its trials is planned yet
        varied |= {*stage.search.space, *stage.search.compare}
    tags = [names.TAG_ENTROPIC_INDEX]
    tags += [tag for name, (_, tag) in IN_WORDS.items() if name in varied]
    tags += [names.TAG_TASK] if len(tasks) > 1 else []
    state = {
        "searchFilter": f"tags.sweep_id = '{sweep_id}' and tags.{names.TAG_CURRENT} = "
        f"'{names.CURRENT}' and tags.stage = '{stage.name}'",
        "orderByKey": "attributes.start_time",
        "orderByAsc": True,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "datasetsFilter": [],
        "selectedColumns": [
            *(f"tags.`{tag}`" for tag in dict.fromkeys((*tags, names.TAG_SEED, names.TAG_TASK))),
            f"metrics.`{metrics[0]}`",
        ],
        "runsHiddenMode": "SHOW_ALL",
        "compareRunCharts": list(_charts(metrics)),
        "compareRunSections": list(_sections()),
        "isAccordionReordered": True,
        "groupBy": {
            "aggregateFunction": "average",
            "groupByKeys": [
                *({"mode": "tag", "groupByData": tag} for tag in dict.fromkeys(tags)),
                *({"mode": "param", "groupByData": name} for name in _varied(plan, stage)),
            ],
        },
        "useGroupedValuesInCharts": True,
        "hideEmptyCharts": True,
    }
    when = round(now * 1000)
    view = {"name": f"{plan.name}: comparison", "createdAt": when, "updatedAt": when}
    return json.dumps({**view, "state": json.dumps(state, separators=(",", ":"))})


def _varied(plan: Plan, stage: Stage) -> list[str]:
    """Params that vary in a stage and that no tag has in full, such as the start of a schedule."""
    seen: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    for run in (node.run for node in plan.nodes if node.stage == stage.name and not node.part):
        settings = run.model_dump(mode="json", exclude={"task", "seed"})
        for name, text in flat_params(settings).items():
            seen[run.task.name, name].add(text)
    return sorted({name for (_, name), of in seen.items() if len(of) > 1 and name not in IN_WORDS})


def _charts(metrics: Sequence[str]) -> Iterator[dict[str, Any]]:
    for number, metric in enumerate(metrics):
        yield _card("LINE", f"line-{number}") | {
            "metricKey": metric,
            "selectedMetricKeys": [metric],
            "lineSmoothness": 0,
            "xAxisScaleType": "linear",
            "scaleType": "linear",
            "range": {},
            "xAxisKey": "step",
            "selectedXAxisMetricKey": "",
            "yAxisKey": "metric",
            "yAxisExpressions": [],
            "ignoreOutliers": False,
            "useGlobalXaxisKey": True,
            "useGlobalLineSmoothing": True,
        }
        if number == 0:
            yield _card("SCATTER", "against-q") | {
                "xaxis": {"key": names.SETTING_ENTROPIC_INDEX, "type": "METRIC"},
                "yaxis": {"key": metric, "type": "METRIC"},
            }


def _card(kind: str, uuid: str) -> dict[str, Any]:
    return {
        "type": kind,
        "uuid": uuid,
        "metricSectionId": SECTION,
        "runsCountToCompare": 100,
        "deleted": False,
        "isGenerated": False,
    }


def _sections() -> Iterator[dict[str, Any]]:
    """The open section of the comparison, and a folded one for each group of metrics."""
    section = {"uuid": SECTION, "name": "Comparison", "display": True, "isReordered": True}
    yield section | {"columns": 2}
    for group in (*names.GROUPS, "Model metrics", "System metrics"):
        section = {"uuid": f"folded-{group}", "name": group, "display": False}
        yield section | {"isReordered": False}
