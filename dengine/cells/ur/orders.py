"""The handshake with a robot's program: one order and one answer, each a number in one register.

dengine writes an order, `10 * number + verb`, into `input_int_register_24`. The program carries it out and writes its
answer, `10 * number + answer`, into `output_int_register_24`; the number is the order's. One register each, so that neither
side can see half of a message; a number each, so that an order sent twice (a connection was lost) is carried out once, and
an old answer is known as old. While the robot inserts, `output_int_register_25` holds the order's number: the trigger.

A program that starts takes up no old order: it answers it with VOID, whatever it was. `training/ur_cell.script` is one.
"""

from __future__ import annotations

from enum import IntEnum

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
    """A controller's `runtime_state`."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


ANSWERS = {
    Verb.INSERT: (Answer.DONE,),
    Verb.VERIFY: (Answer.GOOD, Answer.BAD),
    Verb.PROCEED: (Answer.UNKNOWN, Answer.CONFIRMED, Answer.STOPPED),
    Verb.REJECT: (Answer.DONE,),
}


def word(number: int, what: Verb | Answer) -> int:
    """An order, or an answer, as it stands in its register."""
    return 10 * number + what


def after(number: int) -> int:
    """The number of the next order."""
    return number % MOST + 1
