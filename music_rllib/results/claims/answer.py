"""The first lines of a report: what was asked, the answer with its interval, seeds and control."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from music_rllib import names
from music_rllib.results.claims.contrasts import Verdict
from music_rllib.results.claims.plan import AnalysisPlan
from music_rllib.results.claims.power import seeds_needed
from music_rllib.results.claims.study import Claim, Study, label_of
from music_rllib.results.comparison import ALL_TASKS, interval_text, number, p_text
from music_rllib.results.conditions import FRESH, SEEDS
from music_rllib.results.data import Sweep

MOST_CLAIMS = 4
"""In sentences of their own; the others are in the table."""


def answer(sweep: Sweep, study: Study) -> list[str]:
    """At most ten sentences on a sweep, for its report and `compare`."""
    said = [_asked(study)]
    if study.stage is None or not study.means:
        return [*said, "No run that may be compared has finished yet."]
    shown = [one for one in study.claims if one.task == ALL_TASKS] or list(study.claims)
    mark = bool(study.planned)  # otherwise the first line says it of all
    said += [f"{in_words(one)}{_after(one) if mark else ''}." for one in shown[:MOST_CLAIMS]]
    if not shown and study.afterwards:
        said.append("Nothing that was planned can be tested yet; what was not is in the table.")
    elif not shown:
        only = study.means[0]
        said.append(
            f"Nothing is compared: {label_of(only.condition)} has {only.measure.words} of "
            f"{number(only.estimate.value)} (95 % {interval_text(only.estimate)})."
        )
    if rest := [one for one in study.claims if one not in shown[:MOST_CLAIMS]]:
        counts = Counter(one.verdict for one in rest)
        found = ", ".join(f"{n} {verdict}" for verdict, n in counts.items())
        said.append(f"Of {len(rest)} more comparisons: {found}.")
    said += [_counted(study, shown), _seeds(study, shown), f"Control: {_control(sweep, study)}."]
    if any(one.verdict is Verdict.UNDECIDED for one in study.claims):
        said += filter(None, [seeds_needed(shown, study.means, len(study.claims))])
    said += [f"Not tested: {text}." for text in study.untested[:1]]
    return said


def planned_in_words(study: Study) -> str:
    """Whether there was a plan before the results."""
    plan, latest = study.plan, study.latest
    if plan is not None:
        text = (
            f"planned {plan.recorded}, before its first run finished; version {plan.version}, "
            f"hash {plan.hash[:12]}"
        )
        changed = [] if latest is None else _changed(plan.plan, latest.plan)
        return f"{text}; changed afterwards: {', '.join(changed)}" if changed else text
    if latest is not None:
        return (
            f"planned {latest.recorded}, when runs had finished already: it counts as thought of "
            "afterwards"
        )
    return "nothing was planned beforehand: every comparison here was thought of afterwards"


def _changed(before: AnalysisPlan, after: AnalysisPlan) -> list[str]:
    """Parts of a plan that a later version has otherwise, such as more seeds."""
    known, now = before.model_dump(), after.model_dump()
    return [name.replace("_", " ") for name in known if known[name] != now[name]]


def _asked(study: Study) -> str:
    text = planned_in_words(study)
    if study.question is None:
        return f"{text[0].upper()}{text[1:]}."
    return f"Asked: {study.question} ({text})."


def in_words(claim: Claim) -> str:
    """`q = 1.5 against q = 1 on FetchPush: superior by 0.12 (95 % 0.05 to 0.19; p = 0.002)`."""
    difference = claim.contrast.difference
    gap = (
        f"{float(difference.value):+.2f}"
        if abs(difference.value) < 100
        else number(difference.value)
    )
    ends = "no interval"
    if difference.has_interval:
        ends = f"95 % {interval_text(difference)}"
    tested = p_text(claim.p_value)
    verdict = str(claim.verdict)
    if claim.verdict is Verdict.EQUIVALENT:
        verdict = f"equivalent within {claim.margin:g}"
        tested = p_text(claim.p_equivalent if claim.p_equivalent is not None else 1.0)
    where = "over all tasks" if claim.task == ALL_TASKS else f"on {claim.task}"
    mean = f", mean of {claim.cells} alike in the rest" if claim.cells > 1 else ""
    held = {True: ", as expected", False: ", not as expected", None: ""}[claim.confirmed]
    return (
        f"{claim.first} against {claim.second} {where}{mean}: {verdict}, {gap} ({ends}; {tested})"
        f"{held}"
    )


def _after(claim: Claim) -> str:
    return "" if claim.planned else " (not planned)"


def _counted(study: Study, shown: Sequence[Claim]) -> str:
    measure = (shown[0] if shown else study.means[0]).measure
    area = ", the area under the learning curve" if measure.kind == "auc" else ""
    text = f"Counted: {measure.words}{area}"
    margins = {one.margin for one in shown if one.margin is not None}
    if margins:
        text += f"; a difference below {max(margins):g} does not matter"
    many = len(study.claims)
    return f"{text}; Holm's correction over {many} comparisons." if many > 1 else f"{text}."


def _seeds(study: Study, shown: Sequence[Claim]) -> str:
    runs = sum(one.runs for one in study.means)
    finished = sum(len(one.scores.by_seed) for one in study.means)
    counts = sorted({n for one in shown for n in one.contrast.seeds})
    if not counts:
        counts = sorted({len(one.scores.by_seed) for one in study.means})
    text = f"Seeds: {' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} per condition"
    if counts[-1] < 2:
        text += ", too few for an interval or a test"
    elif shown:
        paired = [one.contrast.paired for one in shown]
        text += ", compared in pairs" if all(paired) else ", not all of them shared"
    if study.stage is not None and any((SEEDS, FRESH) in c.others for c in study.stage.compared):
        text += ", fresh ones that no setting was chosen by"
    return f"{text}; {finished} of {runs} runs are finished."


def _control(sweep: Sweep, study: Study) -> str:
    """What is done for different q to be compared fairly."""
    version = study.plan or study.latest
    if version is not None:
        return version.plan.control
    assert study.stage is not None, "the caller has looked"
    compared = study.stage.compared
    alphas = {
        label_of(one): sweep.runs[run].tags.get(names.TAG_ALPHA, "")
        for one in compared
        for run in one.runs[:1]
    }
    words = sorted(set(alphas.values()))
    if any((SEEDS, FRESH) in one.others for one in compared):
        return f"settings were searched on other seeds; α is {', '.join(words)}"
    if len(words) > 1:
        return f"α varies beside q ({', '.join(words)})"
    same_q = len({one.entropic_index for one in compared}) == 1
    if same_q or any(word in words[0] for word in ("matched", "learned", "normalised")):
        return f"α {words[0]}"
    return f"none, one α ({words[0]}) for all: policies of different q differ in entropy"
