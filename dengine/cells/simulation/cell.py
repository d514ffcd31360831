"""`SimulatedCell`, a robot cell in MuJoCo that a `DataEngine` can drive. `insert_once` simulates
one insertion, by the physics of world.py and the conditions of conditions.py; `read_sensor` adds
the faults of the force sensor. The label follows from the height of the part.

    cell = SimulatedCell(seed=0)
    for cycle in DataEngine().run(cell, cycles=600): ...

It runs as fast as the computer can; `SimulatedCell.clock` counts the seconds that production would
take.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.random import Generator
from scipy.signal import lfilter

from ...errors import DengineError, expect
from ...records import Floats, Outcome, TraceArray, TraceSpec
from .conditions import (
    RATE_HZ,
    SAMPLES,
    CellParameters,
    Conditions,
    draw_conditions,
    find_scenario,
)
from .world import DEPTH_MM, TIME_STEP_S, Push, push

CAUSES = ("none", "missed_grasp", "rim_contact", "wedging", "stuck", "slip", "debris", "wrong_part")
STUCK_MM = 4.0  # a part that stopped at most this far above its seat is "stuck", else "wedging"
SLIP_MM = 1.0  # a part that moved this far in the gripper has slipped


@dataclass(frozen=True, slots=True)
class SensorFaults:
    """Faults of the force sensor in one trace, drawn in the order of the fields.

    All are in newtons but `ripple_hz` (Hz) and `dropped_share` (share of the samples).
    """

    noise_n: float
    ripple_n: float
    ripple_hz: float
    bias_n: float
    drift_n: float
    step_n: float
    dropped_share: float


def read_sensor(
    force: Floats,
    faults: SensorFaults,
    parameters: CellParameters,
    rng: Generator,
) -> TraceArray:
    """Return what the sensor reports of a true force.

    The force passes a low-pass filter of first order, which starts at 0, gets noise, ripple (a
    sine), bias and drift, and is rounded to multiples of `faults.step_n`. The drift grows linearly
    to its full value at the last sample. Then samples are lost, each with the probability
    `faults.dropped_share`, but never the first: a lost sample repeats the last sample that was not
    lost. `rng` is advanced.

    Parameters
    ----------
    force : array of float64, shape (samples,)
        True force along z in newtons, at 500 Hz; at least 2 samples, or all become NaN.
    faults : SensorFaults
        With a `step_n` of 0 all samples become NaN.
    parameters : CellParameters
        Only `bandwidth_hz` is used.
    rng : numpy.random.Generator
        Draws the noise, the phase of the ripple, which samples are lost, and numbers that are not
        used.

    Returns
    -------
    array of float32, shape (samples,)
        In newtons.
    """
    keep = np.exp(-2 * np.pi * parameters.bandwidth_hz / RATE_HZ)
    # The sensor has a low-pass filter of first order.
    true: Floats = lfilter([1 - keep], [1, -keep], force)
    samples = len(true)
    time_s = np.arange(samples) / RATE_HZ
    # Six of each are drawn and one is used, so that the bundled traces can be made again.
    rng.integers(2, size=6)
    phase = rng.uniform(0, 2 * np.pi, size=6)[2]
    slow = faults.bias_n + faults.drift_n * time_s / time_s[-1]
    ripple = faults.ripple_n * np.sin(2 * np.pi * faults.ripple_hz * time_s + phase)
    noise = faults.noise_n * rng.standard_normal((6, samples))[2]
    steps = np.round((true + slow + ripple + noise) / faults.step_n) * faults.step_n
    is_dropped = rng.random(samples) < faults.dropped_share
    newest = np.maximum.accumulate(np.where(is_dropped, 0, np.arange(samples)))  # not dropped
    return np.asarray(steps[newest], dtype=np.float32)


@dataclass(frozen=True, slots=True)
class SimulatedInsertion:
    """One simulated insertion with its label.

    Attributes
    ----------
    trace : array of float32, shape (1000,)
        Force along z in newtons, 500 Hz.
    success : bool
        Whether the final height is within the tolerance. Nothing else enters the label.
    cause : str
        Cause of a failure, one of `CAUSES`; "none" for a success.
    height_mm : float
        Height of the part's top above its nominal seated height.
    cycle : int
        Number of the cell's cycle, from 0.
    conditions : Conditions
        Physical conditions that were drawn.
    sensor : SensorFaults
        Faults of the sensor that were drawn.
    """

    trace: TraceArray
    success: bool
    cause: str
    height_mm: float
    cycle: int
    conditions: Conditions
    sensor: SensorFaults


def insert_once(
    parameters: CellParameters, seed: int, cycle: int, time_step_s: float = TIME_STEP_S
) -> SimulatedInsertion:
    """Simulate one cycle: draw its conditions, push the part, and read the sensor.

    The same `parameters`, `seed` and `cycle` give the same insertion, in any order and process.

    Parameters
    ----------
    parameters : CellParameters
    seed : int
    cycle : int
        Number of the cycle, from 0.
    time_step_s : float
        Step of the physics in seconds, above 0; it must divide 2 ms.

    Returns
    -------
    SimulatedInsertion
        Its `success` says whether the height of the part's top differs from the nominal one by at
        most `parameters.height_tolerance_mm`.

    Raises
    ------
    DengineError
        If MuJoCo is not installed.
    SettingError
        For a time step or sizes that cannot be simulated.
    ValueError
        For ranges or probabilities, also of the sensor, that cannot be drawn from, and for a
        negative seed or cycle.
    OverflowError
        For a range that is not finite.
    """
    world_rng, sensor_rng, _ = _make_generators(seed, cycle)
    conditions = draw_conditions(parameters, world_rng)
    pushed = push(conditions, time_step_s)
    # The faults of the sensor have a stream of their own, so that they do not reveal the outcome.
    faults = SensorFaults(
        *(sensor_rng.uniform(*getattr(parameters, field.name)) for field in fields(SensorFaults))
    )
    faults = replace(faults, bias_n=faults.bias_n + parameters.bias_offset_n)
    success = abs(pushed.height_mm) <= parameters.height_tolerance_mm
    return SimulatedInsertion(
        trace=read_sensor(pushed.force, faults, parameters, sensor_rng),
        success=success,
        cause="none" if success else _find_cause(conditions, pushed),
        height_mm=pushed.height_mm,
        cycle=cycle,
        conditions=conditions,
        sensor=faults,
    )


def _find_cause(conditions: Conditions, pushed: Push) -> str:
    """Return the cause of a failed insertion, one of `CAUSES` except "none".

    `conditions` are those that were drawn, and `pushed` is what came of them. The first rule that
    applies decides. If a missed grasp or a wrong part was drawn, that is the cause. If the part's
    tip stopped on the chamfer of the hole or higher, the cause is "slip" if the part slid up by
    more than `SLIP_MM` (1 mm) in the gripper, else "rim_contact". It is "debris" if debris was
    drawn and the tip stopped at most `SLIP_MM` above it, "slip" if the part slid up by more than
    `SLIP_MM`, "stuck" if the tip stopped at most `STUCK_MM` (4 mm) above the floor of the hole, and
    else "wedging".
    """
    tip_mm = pushed.height_mm - conditions.extra_length_mm  # of the part's tip above the seat
    if conditions.fault in ("missed_grasp", "wrong_part"):
        return conditions.fault
    if tip_mm >= DEPTH_MM - conditions.chamfer_mm:
        return "slip" if pushed.slip_mm > SLIP_MM else "rim_contact"
    if conditions.fault == "debris" and tip_mm <= conditions.debris_mm + SLIP_MM:
        return "debris"
    if pushed.slip_mm > SLIP_MM:
        return "slip"
    return "stuck" if tip_mm <= STUCK_MM else "wedging"


def _make_generators(seed: int, cycle: int) -> list[Generator]:
    """Return three independent random generators of one cycle: for the physical conditions, for the
    sensor, and for what becomes known of a part that was passed on.

    They depend on seed and cycle alone.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(cycle,))).spawn(3)


class SimulatedCell:
    """A simulated `Cell`; after each `insert` call exactly one of verify, proceed and reject.

    Parameters
    ----------
    parameters : CellParameters, optional
        Physical settings.
    scenario : str, default "nominal"
        What changes during the run, a name in `SCENARIOS`.
    seed : int, default 0
        The same seed gives the same insertions, whatever is decided about them.
    cycles : int, default 600
        Length of the scenario; a change "half way" comes after half of these cycles. The robot cell
        can go on after the scenario.

    Attributes
    ----------
    spec : TraceSpec
        Of the traces: 1000 samples at 500 Hz, in newtons.
    clock : float
        Seconds of production so far.
    last : SimulatedInsertion or None
        The newest insertion with its label, for reports; an engine does not read it.

    Raises
    ------
    SettingError
        For an unknown scenario, or fewer cycles than 1.
    """

    spec = TraceSpec(SAMPLES, RATE_HZ, unit="N")

    def __init__(
        self,
        parameters: CellParameters | None = None,
        scenario: str = "nominal",
        seed: int = 0,
        cycles: int = 600,
    ) -> None:
        expect(cycles >= 1, "cycles of at least 1", cycles, "give the length of the run")
        self.parameters = parameters or CellParameters()
        self.seed = seed
        self.cycles = cycles
        self.clock = 0.0
        self.last: SimulatedInsertion | None = None
        self._change = find_scenario(scenario)
        self._waiting = False
        self._done = 0

    @property
    def truth(self) -> bool:
        """Whether the newest part is good; False before the first."""
        return self.last is not None and self.last.success

    def insert(self) -> TraceArray:
        """Pick a part, push it into the fixture, and return the force, float32 of shape (1000,).

        The force is in newtons, 2 s at 500 Hz. `last` becomes this insertion, with its label, and
        `clock` goes on by `cycle_s` seconds, a setting of the robot cell. Raise DengineError if the
        last part still waits for verify, proceed or reject, or if MuJoCo is not installed, and
        SettingError, ValueError or OverflowError for settings that cannot be simulated; nothing
        changes then.
        """
        if self._waiting:
            raise DengineError(
                "Expected verify(), proceed() or reject() after insert(), got insert(); call one."
            )
        insertion = insert_once(
            self._change(self.parameters, self._done, self.cycles), self.seed, self._done
        )
        self.last = insertion
        self._waiting = True
        self.clock += self.parameters.cycle_s
        self._done += 1
        return insertion.trace

    def verify(self) -> bool:
        """Check the height of the part; return whether it is good. A bad one goes back to the bin.

        `clock` goes on by `verify_s` seconds. Afterwards no part waits. Raise DengineError if none
        waits.
        """
        success = self._take_waiting("verify").success
        self.clock += self.parameters.verify_s
        return success

    def proceed(self) -> Outcome:
        """Pass the part on without a check; return what became known of it.

        A bad part stops the line: the result is STOPPED, and `clock` goes on by `stop_s` seconds.
        But with the probability `unreported_share` nobody notices it: the result is UNKNOWN, and
        `clock` stays. Both numbers are fields of `CellParameters`. For a good part the result is
        always UNKNOWN. The same seed and cycle have the same result. Afterwards no part waits.
        Raise DengineError if no part waits for a decision (verify, proceed or reject).
        """
        success = self._take_waiting("proceed").success
        # It depends on the part alone.
        chance = _make_generators(self.seed, self._done - 1)[2].random()
        if success or chance < self.parameters.unreported_share:
            return Outcome.UNKNOWN
        self.clock += self.parameters.stop_s
        return Outcome.STOPPED

    def reject(self) -> None:
        """Send the part back to the bin without a check; this takes no time.

        Afterwards no part waits. Raise DengineError if none waits.
        """
        self._take_waiting("reject")

    def _take_waiting(self, call: str) -> SimulatedInsertion:
        """Return the insertion that waits for verify, proceed or reject; afterwards none waits.

        `call` is the method's name, for the DengineError that is raised if none waits.
        """
        if self.last is None or not self._waiting:
            raise DengineError(
                f"Expected insert() before {call}(), got {call}() with no part waiting; insert one."
            )
        self._waiting = False
        return self.last
