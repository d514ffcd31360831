"""`UrCell`, a cell with a Universal Robots controller that carries out orders: insert, verify,
proceed, reject. `Verb` are the orders, `ResultCode` are the results, and both are numbers in
registers.

with UrCell("192.168.1.10") as cell, DataEngine.open_or_create("cell.db") as engine:
    for cycle in engine.run(cell, cycles=300): ...

dengine and the robot's program exchange numbers in integer registers. dengine writes an order, `10
* number + verb`, to `input_int_register_24`. The program carries it out and writes `10 * number +
result code` to `output_int_register_24`. A single register holds a whole message, so that neither
side can read half of one. Each order has a number of its own, so that an order that is sent twice
is carried out once, and an old result is recognised. While the robot inserts,
`output_int_register_25` holds the order's number, which triggers the recording. A program that
starts anew writes the result code VOID for an order that it finds. `ur_cell.script` beside this
file is such a program.
"""

import time
from contextlib import AbstractContextManager
from dataclasses import replace
from enum import IntEnum
from typing import Any

from ...datasets.triggers import Trigger
from ...errors import CellError
from ...records import Outcome, TraceArray
from .recorder import InsertionRecord, RtdeRecorder
from .stream import Row, StreamReport

ORDER = "input_int_register_24"
ANSWER = "output_int_register_24"
PHASE = "output_int_register_25"
RUNTIME = "runtime_state"
REPEAT_S = 10.0  # an order is written again on a new connection if it is at most this old
MAX_NUMBER = 2 * 10**8  # of an order, then 1 again; ten times as much still fits an int32


class Verb(IntEnum):
    """An order to the robot."""

    INSERT = 1
    VERIFY = 2
    PROCEED = 3
    REJECT = 4


class ResultCode(IntEnum):
    """The result of an order."""

    VOID = 0  # the program was started anew and does not carry the order out
    DONE = 1  # of INSERT and REJECT
    GOOD = 2  # of VERIFY
    BAD = 3  # of VERIFY
    UNKNOWN = 4  # of PROCEED: the line goes on; nothing is known of the part
    CONFIRMED = 5  # of PROCEED: the part is known to be good
    STOPPED = 6  # of PROCEED: the part was bad and stopped the line
    FAILED = 9  # the robot could not do it


class Runtime(IntEnum):
    """Values of a controller's `runtime_state` that matter here."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2  # larger values are PAUSING, PAUSED and RESUMING


OUTCOMES = {ResultCode[outcome.name]: outcome for outcome in Outcome}
SUCCESSES = {  # result codes that an order may have; INSERT and REJECT have DONE
    Verb.VERIFY: (ResultCode.GOOD, ResultCode.BAD),
    Verb.PROCEED: tuple(OUTCOMES),
}
FAILURES: dict[int, str] = {
    ResultCode.VOID: "its program was started anew",
    ResultCode.FAILED: "it reported a failure",
}


def encode_message(number: int, code: Verb | ResultCode) -> int:
    """Return an order or a result as the integer that its register holds, 10 * number + code.

    `number` is that of the order, and `code` the verb, or the result code.
    """
    return 10 * number + code


class UrCell(AbstractContextManager["UrCell"]):
    """A `Cell` whose methods are orders to the program that runs on the robot.

    Each method waits until the robot has carried the order out. The trace is recorded while the
    robot inserts. Missing samples of a trace are NaN: the engine verifies the part and does not
    learn from it. Opening connects to the controller and waits until its program is ready.

    Parameters
    ----------
    host : str
        Name or address of the controller.
    trigger : Trigger or str
        What begins an insertion; see `RtdeRecorder`.
    order_timeout : float, default 60
        Seconds within which the robot must carry out an order.
    start_timeout : float, default 30
        Seconds within which, at first, the program must run and have finished its last order.
    **how
        Further parameters of `RtdeRecorder`.

    Attributes
    ----------
    spec : TraceSpec
        Of the traces, with the rate that the recorder requests.
    last : InsertionRecord or None
        The newest insertion, which says what is missing in its trace.
    incomplete : int
        Number of traces with missing samples.

    Raises
    ------
    CellError
        If the robot does not answer, its program stops, or it reports a failure. Each of the four
        methods of a `Cell` may raise it, too.
    SettingError
        For settings that `RtdeRecorder` refuses.
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
        self.recorder = RtdeRecorder(
            host, trigger, also=(ANSWER, ORDER, RUNTIME), inputs=(ORDER,), **how
        )
        self.spec = self.recorder.spec
        self.order_timeout = order_timeout
        self.start_timeout = start_timeout
        self.last: InsertionRecord | None = None
        self.incomplete = 0
        try:
            self._number = self._wait_until_ready()  # of the last order
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the connection and end its thread; the robot's program goes on."""
        self.recorder.close()

    def __exit__(self, *raised: object) -> None:
        """Close the connection like `close`; an exception of the block passes."""
        self.close()

    def report(self) -> StreamReport:
        """Return the counts of packages since the opening, and of traces with missing samples."""
        return replace(self.recorder.report(), incomplete=self.incomplete)

    def insert(self) -> TraceArray:
        """Have the robot insert a part, wait for that, and return the trace, (T,) or (C, T).

        Lost samples are NaN. All samples are NaN if no insertion was seen, for example because the
        samples at its start were lost, or because the trigger (the condition on the robot's values
        that begins a recording) was never met. An insertion that is not complete when the time for
        the order, `order_timeout`, is over has NaN for the rest. `last` becomes the record of this
        insertion (its trace, and the number of missing samples), and `incomplete` counts the traces
        with missing samples. Raise CellError if the robot does not answer in this time or reports a
        failure, or its program stops. Then nothing is counted, and `last` is None, or the insertion
        if it was complete before, or as much of it as came before a restart of the controller.
        """
        self._execute_order(Verb.INSERT)
        if self.last is None:  # the start was lost, or the trigger is wrong
            self.last = self.recorder.cut()
        self.incomplete += self.last.missing > 0
        return self.last.trace

    def verify(self) -> bool:
        """Have the part measured, wait for that, and return whether it is good.

        A bad part goes back to the bin, if the robot's program does what `ur_cell.script` does.
        Raise CellError like `insert`.
        """
        return self._execute_order(Verb.VERIFY) is ResultCode.GOOD

    def proceed(self) -> Outcome:
        """Have the line go on without measuring, wait for that; return what became known of the
        part.

        Raise CellError like `insert`.
        """
        return OUTCOMES[self._execute_order(Verb.PROCEED)]

    def reject(self) -> None:
        """Have the part put back to the bin without measuring, and wait for that.

        Raise CellError like `insert`.
        """
        self._execute_order(Verb.REJECT)

    def _execute_order(self, verb: Verb) -> ResultCode:
        """Send an order (`verb`) to the robot, wait for its result, and return the result.

        The order gets the next number; after 200,000,000 comes 1. This call waits at most
        `order_timeout` seconds. Packages (the values that the robot sends at once) that were
        received before are discarded. If there is no connection, or it is lost meanwhile, the order
        is written at the first package of the next connection, unless the order is 10 s old by then
        or the controller was restarted: a robot must not move when nobody expects it. The order
        INSERT also waits, within the same time, for the end of a trace that has begun. It sets
        `last` to the insertion, which a restart of the controller cuts short, or to None if none
        was complete by then. Raise CellError if the robot does not answer in time, reports a
        failure or a result that this order cannot have, or if its program stops.
        """
        newest = self.recorder.arm()  # discards what was received between orders
        self._number = self._number % MAX_NUMBER + 1
        is_insertion = verb is Verb.INSERT
        if is_insertion:
            self.last = None
        order = {ORDER: encode_message(self._number, verb)}
        self.recorder.stream.write(order)
        repeat_until = time.monotonic() + REPEAT_S
        result: ResultCode | None = None
        for row in self.recorder.stream.rows(self.order_timeout):
            newest = newest or row
            if row.timestamp < newest.timestamp:  # restarted: the order was meant for before
                repeat_until = 0.0
            elif row.session > newest.session and time.monotonic() < repeat_until:
                self.recorder.stream.write(order)
            newest = row
            if is_insertion and self.last is None:
                self.last = self.recorder.feed(row)
            result = result or self._find_result(row, verb)
            is_recording = is_insertion and self.last is None and self.recorder.begun
            if result and not is_recording:
                break
        if result is None:
            raise self._timeout_error(f"to answer order {self._number} ({verb.name.lower()})")
        return result

    def _timeout_error(self, expected: str) -> CellError:
        """Return (and do not raise) the CellError for a robot that was too slow.

        `expected` says what it had to do, like "to send its state". The message ends with why there
        is no connection, or with advice if there is one.
        """
        reason = "it did not; does its program do what ur_cell.script does, is it paused?"
        if trouble := self.recorder.stream.trouble:
            reason = f"there is no connection: {trouble}"
        return CellError(
            f"Expected the robot at {self.recorder.where} {expected} in time, {reason}"
        )

    def _find_result(self, row: Row, verb: Verb) -> ResultCode | None:
        """Return the result of the present order (`verb`) if the package `row` holds it, else None.

        An order is a command to the robot, and a package is the values that it sends at once. A
        package holds the result if the number in its register of results is that of the order.
        Raise CellError if the result is FAILED, VOID (the program was started anew) or one that
        this order cannot have, or if the robot's program has stopped and this package holds no
        result.
        """
        number, code = divmod(int(row.values[ANSWER]), 10)
        if number == self._number:
            if code in SUCCESSES.get(verb, (ResultCode.DONE,)):
                return ResultCode(code)
            failure = f"{FAILURES.get(code, f'it answered {code}')}; look at the part, then"
        elif int(row.values[RUNTIME]) in (Runtime.STOPPING, Runtime.STOPPED):
            failure = "its program has stopped; start it and"
        else:
            return None
        raise CellError(
            f"Expected the robot to carry out order {self._number} ({verb.name.lower()}), "
            f"{failure} begin again."
        )

    def _wait_until_ready(self) -> int:
        """Wait until the robot's program is ready; return the number of its last order.

        It is ready if it runs and has answered its last order (a command, like INSERT): the numbers
        of the order and of the result in the registers must be equal. Packages (the values that the
        robot sends at once) that arrive before are discarded. Raise CellError after `start_timeout`
        seconds; its message says whether the robot sent nothing, its program does not run, or it
        has not answered.
        """
        problem = ""
        for row in self.recorder.stream.rows(self.start_timeout):
            ordered, answered, state = (int(row.values[name]) for name in (ORDER, ANSWER, RUNTIME))
            problem = f"it owes an answer to order {ordered // 10}"
            if state != Runtime.PLAYING:
                problem = "its program does not run"
            elif ordered // 10 == answered // 10:
                return ordered // 10
        if not problem:
            raise self._timeout_error("to send its state")
        raise CellError(
            f"Expected the robot at {self.recorder.where} to be ready within "
            f"{self.start_timeout:g} s, {problem}; start ur_cell.script of dengine/cells/ur, or "
            "your own program of its handshake, on it."
        )
