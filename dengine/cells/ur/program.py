"""What a robot's program does, played from a data set: the other side of the handshake, where there is no robot."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets import load_dataset
from .channels import CHANNELS, column_of
from .orders import ANSWER, ORDER, PHASE, RUNTIME, Answer, Runtime, Verb, word

Values = dict[str, float]


class RobotProgram:
    """Inserts the traces of a labelled data set, one an order, and behaves as `ReplayCell` does: accepted failures stop.

    dataset : anything that `load_dataset` takes.  channel : what its one channel is; several have their own names.
    confirm : whether an accepted good part is confirmed.  approach, check : cycles before an insertion, and of a check.
    after : cycles of standstill after an insertion, before it is answered.
    `played` : the parts inserted, by their place in the data set.  `place` : part and sample of this cycle, None outside.
    """

    def __init__(
        self,
        dataset: Any,
        channel: str = "FZ_Base",
        confirm: bool = False,
        approach: int = 5,
        check: int = 5,
        after: int = 2,
    ) -> None:
        self.data = load_dataset(dataset)
        self.confirm, self.approach, self.check, self.after = confirm, approach, check, after
        X = self.data.X if self.data.X.ndim == 3 else self.data.X[:, None]
        names = self.data.channels if len(self.data.channels) == X.shape[1] > 1 else tuple(CHANNELS)[: X.shape[1]]
        self._columns = [column_of(name) for name in ((channel,) if X.shape[1] == 1 else names)]
        self._traces: NDArray[np.float64] = X.astype(np.float64)
        self.played: list[int] = []
        self.place: tuple[int, int] | None = None
        self.outputs: Values = {RUNTIME: Runtime.PLAYING, ANSWER: 0, PHASE: 0}
        self._inputs: Values = {}
        self._run = self._cycles()

    def step(self, inputs: Values) -> Values:
        """One control cycle. inputs : registers as clients have written them.  Returns the outputs, by column."""
        self._inputs = inputs
        next(self._run)
        return self.outputs

    def restart(self) -> None:
        """Start it anew: what was ordered is void."""
        self._run = self._cycles()

    def _order(self) -> int:
        return int(self._inputs.get(ORDER, 0))

    def _cycles(self) -> Iterator[None]:
        """The program; each yield ends a control cycle."""
        self.place, last = None, self._order() // 10
        self.outputs.update({PHASE: 0, ANSWER: word(last, Answer.VOID)})
        while True:
            number, verb = divmod(self._order(), 10)
            if number != last:
                answer = yield from self._carry_out(number, verb)
                self.outputs[ANSWER] = word(number, answer)
                last = number
            yield

    def _carry_out(self, number: int, verb: int) -> Any:
        if verb == Verb.INSERT:
            return (yield from self._insert(number))
        if verb not in tuple(Verb) or not self.played:
            return Answer.FAILED
        good = bool(self.data.y[self.played[-1]])
        if verb == Verb.VERIFY:
            yield from self._wait(self.check)
            return Answer.GOOD if good else Answer.BAD
        yield from self._wait(1)
        if verb == Verb.REJECT:
            return Answer.DONE
        return (Answer.CONFIRMED if self.confirm else Answer.UNKNOWN) if good else Answer.STOPPED

    def _insert(self, number: int) -> Any:
        if len(self.played) == len(self.data):
            return Answer.FAILED  # the bin is empty
        part = len(self.played)
        self.played.append(part)
        yield from self._wait(self.approach)
        self.outputs[PHASE] = number
        for sample in range(self._traces.shape[2]):
            self.place = part, sample
            self.outputs.update(zip(self._columns, self._traces[part, :, sample].tolist(), strict=True))
            yield
        self.place = None
        self.outputs.update({PHASE: 0, **dict.fromkeys(self._columns, 0.0)})
        yield from self._wait(self.after)
        return Answer.DONE

    def _wait(self, cycles: int) -> Iterator[None]:
        for _ in range(cycles):
            yield
