"""A cell of a Universal Robots controller, driven by orders to the robot's program: the paper's loop on a real robot.

with UrCell("192.168.1.10") as cell, DataEngine.open_or_create("cell.db") as engine:
    for cycle in engine.run(cell, cycles=300): ...

The handshake is one order and one answer, each a number in one register. dengine writes `10 * number + verb` into
`input_int_register_24`; the program carries it out and writes `10 * number + answer` into `output_int_register_24`. One
register each, so that neither side can see half of a message; a number each, so that an order sent twice is carried out
once, and an old answer is known as old. While the robot inserts, `output_int_register_25` holds the order's number: the
trigger. A program that starts answers an old order with VOID. `training/ur_cell.script` is one.
"""

from contextlib import AbstractContextManager
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets.triggers import Trigger
from ...errors import CellError
from ...records import Outcome
from .recorder import InsertionRecord, RtdeRecorder
from .stream import Row, StreamReport

ORDER = "input_int_register_24"
ANSWER = "output_int_register_24"
PHASE = "output_int_register_25"
RUNTIME = "runtime_state"
MOST = 2 * 10**8  # numbers begin again at 1: ten times as much is an int32 still


class Verb(IntEnum):
    """What the robot is told to do."""

    INSERT = 1
    VERIFY = 2
    PROCEED = 3
    REJECT = 4


class Answer(IntEnum):
    """What came of it."""

    VOID = 0  # the program was started anew: the order is not carried out
    DONE = 1  # to INSERT and REJECT
    GOOD = 2  # to VERIFY
    BAD = 3  # to VERIFY
    UNKNOWN = 4  # to PROCEED: the line went on, and says no more
    CONFIRMED = 5  # to PROCEED: the part is known to be fine
    STOPPED = 6  # to PROCEED: the part was bad, and stopped the line
    FAILED = 9  # the robot could not do it


class Runtime(IntEnum):
    """A controller's `runtime_state`, as far as it matters here."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2  # then PAUSING, PAUSED and RESUMING, which end by themselves


OUTCOMES = {Answer[outcome.name]: outcome for outcome in Outcome}
ANSWERS = {Verb.VERIFY: (Answer.GOOD, Answer.BAD), Verb.PROCEED: tuple(OUTCOMES)}  # to the others DONE
REFUSALS: dict[int, str] = {Answer.VOID: "its program was started anew", Answer.FAILED: "it says that it failed"}


def word(number: int, what: Verb | Answer) -> int:
    """An order, or an answer, as it stands in its register."""
    return 10 * number + what


class UrCell(AbstractContextManager["UrCell"]):
    """A `Cell` whose insert, verify, proceed and reject are orders to the program that runs on the robot.

    host, trigger, how : as in `RtdeRecorder`; the trace is recorded while the robot inserts.
    order_timeout : seconds for each order to be answered.  start_timeout : seconds, at first, for the program to run and to
    have finished what an earlier owner ordered.

    A trace with a gap is handed on with NaN in it: the engine verifies that part and never learns from it; `last` says what
    is missing, `incomplete` counts them. CellError where the robot does not answer, its program stops, or it says FAILED.
    """

    def __init__(
        self,
        host: str,
        trigger: Trigger | str = f"register@{PHASE}",
        *,
        order_timeout: float = 60.0,
        start_timeout: float = 30.0,
        **how: Any,
    ) -> None:
        self.recorder = RtdeRecorder(host, trigger, also=(ANSWER, ORDER, RUNTIME), inputs=(ORDER,), **how)
        self.order_timeout, self.start_timeout = order_timeout, start_timeout
        self.last: InsertionRecord | None = None
        self.incomplete = 0
        try:
            self._number = self._take_over()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self.recorder.close()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def report(self) -> StreamReport:
        """Counts of all packages, and of the traces with a gap."""
        return replace(self.recorder.report(), incomplete=self.incomplete)

    def insert(self) -> NDArray[np.float32]:
        """Pick a part, push it in, and give the force: (T,) or (C, T), NaN where a sample never came."""
        self._ask(Verb.INSERT)
        if self.last is None:  # answered, and no start was seen: the trigger fell into a gap, or is the wrong one
            self.last = self.recorder.cut()
        self.incomplete += self.last.missing > 0
        return self.last.trace

    def verify(self) -> bool:
        """Have what was inserted measured: True for a success. A bad part goes back to the bin."""
        return self._ask(Verb.VERIFY) is Answer.GOOD

    def proceed(self) -> Outcome:
        """Go on without measuring; what the line says of the part."""
        return OUTCOMES[self._ask(Verb.PROCEED)]

    def reject(self) -> None:
        """Back to the bin, not measured."""
        self._ask(Verb.REJECT)

    def _ask(self, verb: Verb) -> Answer:
        """Give one order, and read until it is answered; an insertion also until its trace is over."""
        self.recorder.arm()  # what came while nothing was asked is nobody's
        self._number = self._number % MOST + 1
        self.last = None if verb is Verb.INSERT else self.last
        self.recorder.stream.write({ORDER: word(self._number, verb)})
        answer: Answer | None = None
        for row in self.recorder.rows(self.order_timeout):
            if verb is Verb.INSERT and self.last is None:
                self.last = self.recorder.feed(row)
            answer = answer or self._answered(row, verb)
            if answer and not (verb is Verb.INSERT and self.last is None and self.recorder.begun):
                break
        if answer is None:
            raise self._silence(f"to answer order {self._number} ({verb.name.lower()})")
        self.recorder.stream.write(None)
        return answer

    def _silence(self, what: str) -> CellError:
        stream, why = self.recorder.stream, "it did not; does its program do what ur_cell.script does, is it paused?"
        why = f"there is no connection: {stream.trouble}" if stream.trouble else why
        return CellError(f"Expected the robot at {stream.where} {what} in time, {why}")

    def _answered(self, row: Row, verb: Verb) -> Answer | None:
        """The answer to the order under way, if this package holds it; CellError for one that is no success."""
        number, what = divmod(int(row.values[ANSWER]), 10)
        state = int(row.values[RUNTIME])
        about = f"order {self._number} ({verb.name.lower()})"
        if number == self._number:
            if what in ANSWERS.get(verb, (Answer.DONE,)):
                return Answer(what)
            said = REFUSALS.get(what, f"it answered {what}")
            raise CellError(f"Expected the robot to carry out {about}, {said}; look at the part, then begin again.")
        if state in (Runtime.STOPPING, Runtime.STOPPED):
            raise CellError(f"Expected the robot to carry out {about}, its program has stopped; start it, begin again.")
        return None

    def _take_over(self) -> int:
        """The number of the last order there was, once it is answered and the program runs."""
        what = ""
        for row in self.recorder.rows(self.start_timeout):
            ordered, answered, state = (int(row.values[name]) for name in (ORDER, ANSWER, RUNTIME))
            if state == Runtime.PLAYING and ordered // 10 == answered // 10:
                return ordered // 10
            owing = f"it owes an answer to order {ordered // 10}"
            what = owing if state == Runtime.PLAYING else "its program does not run"
        if not what:
            raise self._silence("to send its state")
        do = "start training/ur_cell.script, or your own program of the same handshake, on it"
        where = f"the robot at {self.recorder.stream.where}"
        raise CellError(f"Expected {where} to be ready within {self.start_timeout:g} s, {what}; {do}.")
