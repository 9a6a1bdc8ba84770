"""Play environments before anything is trained, and report their problems.

This is the program of a child process, since an environment may abort, end or block its process.
`music_rllib.sweep.preflight` starts it with a folder. It reads a `Request` from the file `request`
and appends JSON lines to the file `answers`: `["call", task, name]` before a call of an environment
(at most once a second for repeated calls) and `["done", task, problems, remarks, sizes]` for each
task.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from music_rllib.envs.probe import Probe, Question

REQUEST, ANSWERS = "request", "answers"


class Request(BaseModel):
    """The tasks to play, and the maximum duration of one call in seconds."""

    questions: list[Question]
    seconds: float | None


class _Reporter:
    """Report calls to the parent, and end this process if one takes too long."""

    def __init__(self, answers: Path, seconds: float | None) -> None:
        self._answers, self._seconds = answers.open("a"), seconds
        self.task = self._call = ""
        self._reported = 0.0

    def __call__(self, call: str) -> None:
        now = time.monotonic()
        if call == self._call and now - self._reported < 1.0:
            return
        self._call, self._reported = call, now
        self.write("call", self.task, call)
        if self._seconds is not None:
            faulthandler.dump_traceback_later(self._seconds, exit=True)

    def write(self, *line: Any) -> None:
        print(json.dumps(line), file=self._answers, flush=True)


def main() -> None:
    """Answer the request in the folder that the argument names."""
    folder = Path(sys.argv[1])
    with contextlib.suppress(OSError):  # if memory runs out, the system ends this process first
        Path("/proc/self/oom_score_adj").write_text("1000")
    faulthandler.enable()
    request = Request.model_validate_json((folder / REQUEST).read_text())
    reporter = _Reporter(folder / ANSWERS, request.seconds)
    for question in request.questions:
        reporter.task = question.task.name
        probe = Probe(question, reporter)
        probe.run()
        reporter.write("done", question.task.name, probe.problems, probe.remarks, probe.sizes)
    os._exit(0)  # without waiting for threads of the environments


if __name__ == "__main__":
    main()
