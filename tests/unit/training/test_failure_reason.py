"""The cause of a run's failure in one or two lines."""

import os
import re

import pytest
from ray.exceptions import ActorDiedError, OutOfMemoryError, RayActorError, RayTaskError

from music_rllib.errors import BadInputError
from music_rllib.training.failure_reason import cause_of, in_words_only, trace_of

DEATH = """The actor died unexpectedly before finishing this task.
\tclass_name: RunTrainable
\tactor_id: fcaed09f3f21d6b1548c74ea01000000
\tpid: 18609
\tip: 10.0.0.2
The actor is dead because its worker process has died. Worker exit type: SYSTEM_ERROR Worker exit \
detail: Worker unexpectedly exits with a connection error code 2. End of file. Some common causes \
include: (1) the process was killed by the OOM killer due to high memory usage
"""


def in_a_task(cause: Exception) -> RayTaskError:
    return RayTaskError("RunTrainable.train()", f"Traceback:\n  File\n{cause!r}", cause)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (in_a_task(ValueError("must be > 0")), "ValueError: must be > 0"),
        (in_a_task(RuntimeError("one\n\ntwo\nthree")), "RuntimeError: one\ntwo"),
        (OutOfMemoryError("low on memory\nby 3 GB\nand more"), "low on memory\nby 3 GB"),
        (ActorDiedError(in_a_task(ImportError("no module"))), "ImportError('no module')"),
        (None, "KeyError: 'the last line'"),
    ],
    ids=["one line", "many lines", "memory", "never came up", "not readable"],
)
def test_the_cause_is_the_original_exception(error: BaseException | None, expected: str) -> None:
    assert cause_of(error, "Traceback:\n  File\nKeyError: 'the last line'\n\n") == expected


class WordlessError(Exception):
    """An exception with two arguments, whose message cannot be read."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__(first, second)

    def __str__(self) -> str:
        raise LookupError


def test_an_exception_without_a_readable_message_keeps_its_name() -> None:
    assert (
        cause_of(WordlessError(1, 2), "")
        == "WordlessError: (its message can't be read: LookupError)"
    )
    assert cause_of(SystemExit(3), "") == "SystemExit: 3"
    latin_1 = ValueError(os.fsdecode(b"caf\xe9.xml"))
    assert cause_of(latin_1, "") == "ValueError: caf\\udce9.xml"
    trace_of(latin_1).encode()
    assert cause_of(ValueError("\x1b[1m\x1b[31mred\x1b[0m"), "") == "ValueError: red"
    with pytest.raises(BadInputError, match=r"^WordlessError: "), in_words_only():
        raise WordlessError(1, 2)


def test_a_dead_worker_is_reported_with_its_place_and_advice() -> None:
    first, second = cause_of(RayActorError(error_msg=DEATH), DEATH).splitlines()
    assert first == (
        "The worker process died (pid 18609, ip 10.0.0.2): Worker unexpectedly exits with a "
        "connection error code 2. End of file."
    )
    assert "lack of memory" in second
    assert "continues from the last checkpoint" in second


def test_a_memory_error_reports_the_free_memory() -> None:
    first, second = cause_of(in_a_task(MemoryError()), "").splitlines()
    assert first == "MemoryError: no memory was left"
    assert re.match(r"The process had \d+\.\d GiB, \d+\.\d of the machine's \d+\.\d GiB", second)
    assert "replay.capacity" in second


def test_long_lines_are_cut() -> None:
    assert len(cause_of(in_a_task(ValueError("x" * 5000)), "")) == 300
