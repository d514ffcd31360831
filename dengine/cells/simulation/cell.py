"""A simulated robot cell that a `DataEngine` can drive: bin, gripper, fixture and height check in MuJoCo.

    cell = SimulatedCell(seed=0)
    for cycle in DataEngine().run(cell, cycles=600): ...

Nothing waits: the cell's clock counts the seconds that production would have taken.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from ...errors import DengineError, expect
from ...records import Outcome
from .conditions import RATE_HZ, CellParameters, Conditions, draw_conditions, find_scenario
from .world import DEPTH_MM, TIME_STEP_S, Push, push

CAUSES = ("none", "missed_grasp", "rim_contact", "wedging", "stuck", "slip", "debris", "wrong_part")
STUCK_MM = 4.0  # a part that came this close to its seat is stuck above it, one further up is wedged
SLIP_MM = 1.0  # a part that moved this far in the gripper has slipped


@dataclass(frozen=True, slots=True)
class SensorFaults:
    """One trace's draw, in this order. All in newtons, but for `ripple_hz` and `dropped_share`."""

    noise_n: float
    ripple_n: float
    ripple_hz: float
    bias_n: float
    drift_n: float
    step_n: float
    dropped_share: float


def read_sensor(
    force: NDArray[np.float64], faults: SensorFaults, parameters: CellParameters, rng: np.random.Generator
) -> NDArray[np.float32]:
    """What the sensor reports of a true z-force (samples,) in newtons, as float32."""
    keep = float(np.exp(-2 * np.pi * parameters.bandwidth_hz / RATE_HZ))
    true: NDArray[np.float64] = lfilter([1 - keep], [1, -keep], force)  # the first-order low-pass in the sensor
    samples = len(true)
    time_s = np.arange(samples) / RATE_HZ
    # The bundled traces were made with this draw, and with the other five of what is drawn in sixes.
    rng.integers(2, size=6)
    phase = rng.uniform(0, 2 * np.pi, size=6)[2]
    slow = faults.bias_n + faults.drift_n * time_s / time_s[-1]
    ripple = faults.ripple_n * np.sin(2 * np.pi * faults.ripple_hz * time_s + phase)
    noise = faults.noise_n * rng.standard_normal((6, samples))[2]
    steps = np.round((true + slow + ripple + noise) / faults.step_n) * faults.step_n
    arrived = np.where(rng.random(samples) < faults.dropped_share, 0, np.arange(samples))
    return np.asarray(steps[np.maximum.accumulate(arrived)], dtype=np.float32)  # a dropped sample: the last that arrived


@dataclass(frozen=True, slots=True)
class Insertion:
    """One simulated insertion and its truth.

    trace : (1000,) float32, the z-force in newtons.
    success : whether the final height is within the tolerance; nothing else enters the label.
    cause : of a failure, one of `CAUSES`; `"none"` for a success.
    height_mm : of the part's top over its nominal seated height.
    cycle : of the cell.  conditions, sensor : what was drawn.
    """

    trace: NDArray[np.float32]
    success: bool
    cause: str
    height_mm: float
    cycle: int
    conditions: Conditions
    sensor: SensorFaults


def insert_once(parameters: CellParameters, seed: int, cycle: int, time_step_s: float = TIME_STEP_S) -> Insertion:
    """Simulate one cycle. The same `parameters`, `seed` and `cycle` give the same insertion, in any order or process.

    time_step_s : of the physics.
    """
    world_rng, sensor_rng, _ = _streams(seed, cycle)
    conditions = draw_conditions(parameters, world_rng)
    pushed = push(conditions, time_step_s)
    # The sensor's faults have a stream of their own: nothing but the force itself can tell the outcome.
    faults = SensorFaults(*(float(sensor_rng.uniform(*getattr(parameters, each.name))) for each in fields(SensorFaults)))
    faults = replace(faults, bias_n=faults.bias_n + parameters.bias_offset_n)
    success = abs(pushed.height_mm) <= parameters.height_tolerance_mm
    return Insertion(
        trace=read_sensor(pushed.force, faults, parameters, sensor_rng),
        success=success,
        cause="none" if success else _cause(conditions, pushed),
        height_mm=pushed.height_mm,
        cycle=cycle,
        conditions=conditions,
        sensor=faults,
    )


def _cause(conditions: Conditions, pushed: Push) -> str:
    """Name the cause of a failure: the fault that was drawn if it took effect, else where the part came to rest."""
    tip_mm = pushed.height_mm - conditions.extra_length_mm  # of the part's tip over the seat
    if conditions.fault in ("missed_grasp", "wrong_part"):
        return conditions.fault
    if tip_mm >= DEPTH_MM - conditions.chamfer_mm:
        return "slip" if pushed.slip_mm > SLIP_MM else "rim_contact"
    if conditions.fault == "debris" and tip_mm <= conditions.debris_mm + SLIP_MM:
        return "debris"
    if pushed.slip_mm > SLIP_MM:
        return "slip"
    return "stuck" if tip_mm <= STUCK_MM else "wedging"


def _streams(seed: int, cycle: int) -> tuple[np.random.Generator, np.random.Generator, np.random.Generator]:
    """Independent streams of one cycle: for the world, for the sensor, and for what the line notices afterwards."""
    world, sensor, line = np.random.SeedSequence(entropy=seed, spawn_key=(cycle,)).spawn(3)
    return np.random.default_rng(world), np.random.default_rng(sensor), np.random.default_rng(line)


class SimulatedCell:
    """A `Cell` whose parts, forces and heights come from physics, and whose clock is simulated.

    parameters : every physical setting, see `CellParameters`.
    scenario : what changes while it runs, a name in `SCENARIOS`.
    seed : the same seed gives the same insertions, whatever is decided about them.
    cycles : length of the run a scenario is laid over; "half way" is half of it. The cell goes on after it.
    """

    def __init__(
        self, parameters: CellParameters | None = None, scenario: str = "nominal", seed: int = 0, cycles: int = 600
    ) -> None:
        expect(cycles >= 1, "cycles of at least 1", cycles, "give the length of the run")
        self.parameters = parameters or CellParameters()
        self.scenario, self.seed, self.cycles = scenario, seed, cycles
        self.clock = 0.0
        self.last: Insertion | None = None  # the truth about the part in the cell: for reports, never for an engine
        self._change = find_scenario(scenario)
        self._waiting = False
        self._done = 0

    @property
    def truth(self) -> bool:
        """Whether the part just inserted is good."""
        return self.last is not None and self.last.success

    def insert(self) -> NDArray[np.float32]:
        """Pick a part, push it into the fixture, return the force: newtons at 500 Hz for 2 s."""
        if self._waiting:
            raise DengineError("Expected verify(), proceed() or reject() after insert(), got insert(); call one.")
        changed = self._change(self.parameters, self._done, self.cycles)
        insertion = insert_once(changed, self.seed, self._done)
        self.last, self._waiting = insertion, True
        self.clock += self.parameters.cycle_s
        self._done += 1
        return insertion.trace

    def verify(self) -> bool:
        """Check the height; a good part goes on, a bad one back to the bin."""
        success = self._take("verify").success
        self.clock += self.parameters.verify_s
        return success

    def proceed(self) -> Outcome:
        """Pass the part on unverified. A bad one stops the system, but for its silent share."""
        success = self._take("proceed").success
        chance = float(_streams(self.seed, self._done - 1)[2].random())  # of this part, whatever was decided before
        if success:
            return Outcome.CONFIRMED if chance < self.parameters.confirm_share else Outcome.UNKNOWN
        if chance < self.parameters.silent_share:
            return Outcome.UNKNOWN
        self.clock += self.parameters.stop_s
        return Outcome.STOPPED

    def reject(self) -> None:
        """Send the part back to the bin unverified; a good one has to be picked and inserted once more."""
        self._take("reject")

    def _take(self, call: str) -> Insertion:
        if self.last is None or not self._waiting:
            raise DengineError(f"Expected insert() before {call}(), got {call}() with no part waiting; insert one.")
        self._waiting = False
        return self.last
