"""Five journeys through the package, from traces, and their section of the docs.

python -m tests.journeys            # exit code 1 if the section is out of date
python -m tests.journeys --write    # write it

A trace runs in its own process and lists every function of the package in the order of its first
call, and the files with these functions. Class bodies count as functions, as in `sys.setprofile`.
"""

from __future__ import annotations

import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from tests.processes import fresh

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
EXPORT = ROOT / "docs/results/data/q-at-equal-pressure"
MOST_DRIVER_MODULES = 54
"""Largest number of modules of the package that `import music_rllib.sweep.driver` may load."""
START, END = "## Five journeys\n", "## Where to add something\n"
_NAME = re.compile(r"`(music_rllib(?:\.\w+)+):(\w+)`|`([A-Z]\w+\.\w+)`")


class Called:
    """The functions of the package in the order of their first call."""

    def __init__(self) -> None:
        self.functions: dict[str, None] = {}
        """`module:qualified name`."""

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Record the calls in this thread until the end of the `with`."""
        package = str(ROOT / "music_rllib") + os.sep

        def profile(frame: FrameType, event: str, _: object) -> None:
            file, name = frame.f_code.co_filename, frame.f_code.co_qualname
            if event == "call" and name != "<module>" and file.startswith(package):
                module = file.removeprefix(f"{ROOT}{os.sep}").removesuffix(".py")
                self.functions[f"{module.replace(os.sep, '.')}:{name}"] = None

        sys.setprofile(profile)
        try:
            yield
        finally:
            sys.setprofile(None)


def trace_plan(called: Called, folder: Path) -> None:
    """`music-rllib plan` of the README's sweep."""
    from music_rllib.program import main

    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (folder / "my_sweep.yaml").write_text(readme.partition("```yaml\n")[2].partition("```")[0])
    with called.recording():
        assert main(["plan", "my_sweep.yaml"]) == 0


def trace_loss(called: Called, folder: Path) -> None:
    """The loss of one minibatch for the packaged sweep, in a learner without Ray."""
    import gymnasium as gym
    import numpy as np
    import torch
    from ray.rllib.core import DEFAULT_MODULE_ID

    spaces = (gym.spaces.Box(-np.inf, np.inf, (6,)), gym.spaces.Box(-1.0, 1.0, (3,)))
    batch = {
        "obs": torch.randn(8, 6),
        "new_obs": torch.randn(8, 6),
        "actions": torch.rand(8, 3),
        "rewards": torch.randn(8),
        "discounts": torch.ones(8),
        "noise": torch.randn(8, 3),
    }
    with called.recording():
        from music_rllib.sweep import driver
        from music_rllib.training.run import algorithm_config

        config = driver.load(None, storage=str(folder))
        run = next(iter(config.stages[-1].points[-1].runs.values()))
        rllib = algorithm_config(run)
        rllib.environment(observation_space=spaces[0], action_space=spaces[1])
        learner: Any = rllib.build_learner(spaces={DEFAULT_MODULE_ID: spaces})
        learner._losses, learner._observed = {}, {}
        forward = learner.module[DEFAULT_MODULE_ID].forward_train(batch)
        learner.compute_loss_for_module(
            module_id=DEFAULT_MODULE_ID, config=learner.config, batch=batch, fwd_out=forward
        )


def trace_weights(called: Called, folder: Path) -> None:
    """A handoff through the storage."""
    from music_rllib.store.handoff import read_handoff
    from music_rllib.store.node_store import NodeStore
    from tests.handoffs import music_u, write_estimator

    run = music_u()
    with called.recording():
        write_estimator(folder / "made/handoff", run)
        store = NodeStore(str(folder))
        store.publish("0" * 20, folder / "made")
        store.fetch("0" * 20, folder / "fetched")
        read_handoff(folder / "fetched/handoff", ["mi_estimator"], run.task)


def trace_search(called: Called, folder: Path) -> None:
    """A search of two trials whose runs are computed by a formula."""
    from tests.played_search import searched

    with called.recording():
        searched(folder, {"trials": 2})


def trace_report(called: Called, _: Path) -> None:
    """The report of an exported sweep with an analysis plan."""
    from music_rllib.report.build import WANTED, build_report
    from music_rllib.results.read import read_sweep

    sweep = read_sweep(str(EXPORT), metrics=WANTED).sweep
    assert sweep.plans
    with called.recording():
        build_report(sweep)


@dataclass(frozen=True, kw_only=True)
class Journey:
    """Steps of a journey, and the trace that shows some of them."""

    title: str
    steps: Sequence[str]
    """Markdown with the names of functions, in their order."""
    trace: Callable[[Called, Path], None]
    traced: Sequence[int]
    """Numbers of the steps whose functions the trace calls; the last ones in this order."""
    example: str
    """Description of the traced example."""
    most_files: int
    """Largest number of files of the package that the trace may enter."""


JOURNEYS = {
    "plan": Journey(
        title="From a YAML file to a training step",
        steps=(
            "`music_rllib.sweep.driver:load` reads, checks and resolves the file with "
            "`music_rllib.config.load:load_config`",
            "`music_rllib.experiment.plan:make_plan` makes a graph of runs, each with its key: "
            "`music_rllib.experiment.plan:node_key`",
            "`music_rllib.sweep.preflight:check_environments` plays declared environments in a "
            "child process, `music_rllib.envs.fingerprint:fingerprint_of` identifies their code",
            "`music_rllib.experiment.open_sweep:open_sweep` finds the runs that the storage "
            "already has",
            "`music_rllib.sweep.driver:plan` shows the plan with "
            "`music_rllib.sweep.views.plan:plan_view`, and ends here",
            "`music_rllib.sweep.driver:run` passes the other runs to Tune: "
            "`music_rllib.sweep.execution:compute_and_report`, `music_rllib.tune.runner:compute`",
            "`music_rllib.training.worker:RunTrainable` takes a run's lease, and starts the run or "
            "resumes it from its `music_rllib.store.work_folder:WorkFolder`",
            "`music_rllib.training.run:TrainingRun` builds the algorithm with "
            "`music_rllib.training.run:algorithm_config`",
            "`music_rllib.tac.algorithm:TAC` collects, stores, samples and updates: "
            "`TAC.training_step`",
        ),
        trace=trace_plan,
        traced=(1, 2, 3, 4, 5),
        example="`music-rllib plan` of the README's sweep",
        most_files=40,
    ),
    "loss": Journey(
        title="From `entropic_index` to the loss",
        steps=(
            "`music_rllib.config.tac_settings:TACSettings` validates it",
            "`music_rllib.training.run:algorithm_config` passes it to "
            "`music_rllib.tac.algorithm:TACConfig`",
            "`music_rllib.tac.losses:ScheduledSettings` has its current value",
            "`music_rllib.tac.losses:TACLoss` uses it: `TACLoss.losses`, `TACLoss.ln_q`",
            "`music_rllib.functional.actor_critic:policy_loss` is the formula",
            "`music_rllib.tac.compiled_update:CompiledUpdate` calls the compiled form in "
            "`kernels/update.py`, with the same formulas and their derivatives",
        ),
        trace=trace_loss,
        traced=(1, 2, 3, 4, 5),
        example="the loss of a minibatch for the packaged sweep",
        most_files=80,
    ),
    "weights": Journey(
        title="From MUSIC-u's weights to MUSIC-r's reward",
        steps=(
            "`music_rllib.training.run:TrainingRun` returns its networks as arrays: "
            "`TrainingRun.network_weights`",
            "`music_rllib.store.handoff:write_handoff` writes them with their hashes",
            "`music_rllib.store.node_store:NodeStore` publishes the run: `NodeStore.publish`",
            "`music_rllib.store.handoff:read_handoff` checks and reads them in the worker of the "
            "next run",
            "`music_rllib.tac.algorithm:TAC` sets them: `TAC.set_network_weights`",
            "`music_rllib.intrinsic.music:Music` computes the reward of every minibatch: "
            "`Music.reward`",
        ),
        trace=trace_weights,
        traced=(2, 3, 4),
        example="a handoff through a storage",
        most_files=10,
    ),
    "search": Journey(
        title="From a result to Optuna",
        steps=(
            "`music_rllib.training.worker:RunTrainable` reports",
            "`music_rllib.tune.events:TuneEvents` turns Tune's callbacks into events of runs",
            "`music_rllib.search.controller:SearchController` receives them: the event of a "
            "trial's last run scores the trial (`SearchController.finished`)",
            "`music_rllib.search.objective:score` and `music_rllib.search.objective:aggregate` "
            "compute the trial's value",
            "`music_rllib.search.study:OptunaStudy` gives Optuna the value (`OptunaStudy.end`)",
            "`music_rllib.tune.runner:DagSearcher` asks for the next run when Tune has room, "
            "`SearchController.propose` claims the next trial (`OptunaStudy.claim`)",
        ),
        trace=trace_search,
        traced=(3, 4, 5),
        example="a search of two trials",
        most_files=38,
    ),
    "report": Journey(
        title="From a metric to the report",
        steps=(
            "`music_rllib.tac.learner:TACLearner` measures it, under a name of `music_rllib.names`",
            "`music_rllib.store.history:Report` keeps it in the run's history",
            "`music_rllib.store.node_store:NodeStore` has the history of finished runs, "
            "`music_rllib.store.work_folder:WorkFolder` the history of other runs up to their last "
            "checkpoint",
            "the runs of the current plan become a `music_rllib.results.data:Sweep` in "
            "`music_rllib.results.read:read_sweep`",
            "`music_rllib.report.build:build_report` computes the report",
            "`music_rllib.results.analysis:analyse` computes curves and final values, "
            "`music_rllib.results.study:study_of` the verdicts",
            "`music_rllib.report.build:write_report` writes the page and the figures",
        ),
        trace=trace_report,
        traced=(5, 6),
        example="the report of an export with an analysis plan",
        most_files=14,
    ),
}


def names_of(step: str) -> list[str]:
    """The functions and classes that a step names: `module:name`, or `Class.method`."""
    return [f"{m[1]}:{m[2]}" if m[1] else m[3] for m in _NAME.finditer(step)]


def first_call(name: str, functions: Sequence[str]) -> int | None:
    """Position of the first call of a function, a method, or any method of a class."""
    is_class = name.rpartition(":")[2][0].isupper() and ":" in name
    for position, called in enumerate(functions):
        # The body of a class runs when it is imported.
        exact = called == name and not is_class
        if exact or called.startswith(f"{name}.") or called.partition(":")[2] == name:
            return position
    return None


def observed(journey: str) -> list[str]:
    """The functions of a journey in the order of their first call, in a process of its own."""
    kept = ("PATH", "HOME", "LANG", "TMPDIR", "VIRTUAL_ENV")
    environment = {name: os.environ[name] for name in kept if name in os.environ}
    environment |= {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    done = fresh("-m", "tests.journeys", "--trace", journey, cwd=ROOT, env=environment)
    functions: list[str] = json.loads(done.stdout.splitlines()[-1])
    return functions


def files_of(functions: Sequence[str]) -> int:
    """Number of files that have these functions."""
    return len({called.partition(":")[0] for called in functions})


def driver_modules() -> int:
    """Number of modules of the package that `import music_rllib.sweep.driver` loads."""
    code = (
        "import sys, music_rllib.sweep.driver\n"
        "print(sum(name.partition('.')[0] == 'music_rllib' for name in sys.modules))"
    )
    return int(fresh("-c", code, cwd=ROOT).stdout)


def section() -> str:
    """The section of the page."""
    lines = [
        START,
        "`python -m tests.journeys --write` writes this section. A test traces each journey. It "
        "checks that the traced steps\ncall their functions in this order, and that the number of "
        "files is not exceeded.\n",
    ]
    for journey in JOURNEYS.values():
        lines.append(f"### {journey.title}\n")
        lines += [f"{number}. {step}" for number, step in enumerate(journey.steps, 1)]
        lines.append(
            f"\nTraced: steps {journey.traced[0]} to {journey.traced[-1]}, in {journey.example}. "
            f"The trace enters at most {journey.most_files} files of the package.\n"
        )
    loads = f"`import music_rllib.sweep.driver` loads at most {MOST_DRIVER_MODULES} modules."
    return "\n".join((*lines, f"{loads}\n\n"))


def with_section(page: str) -> str:
    """The page with the section as it is now."""
    before, _, rest = page.partition(START)
    return before + section() + END + rest.partition(END)[2]


def main(arguments: Sequence[str]) -> int:
    """Check or write the section, or print a trace; the exit code."""
    if arguments[:1] == ["--trace"]:
        called = Called()
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                JOURNEYS[arguments[1]].trace(called, Path(folder))
            os.chdir(ROOT)
        print(json.dumps(list(called.functions)))
        return 0
    page = PAGE.read_text(encoding="utf-8")
    new = with_section(page)
    if arguments == ["--write"]:
        PAGE.write_text(new, encoding="utf-8")
        return 0
    return int(new != page)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
