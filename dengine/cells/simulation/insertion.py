"""One simulated insertion: draw the conditions, push, read the sensor, measure the height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .conditions import Conditions, draw_conditions
from .parameters import CHANNELS, CellParameters
from .sensor import SensorFaults, draw_sensor, read_sensor
from .world import DEPTH_MM, TIME_STEP_S, Push, push

CAUSES = ("none", "missed_grasp", "rim_contact", "wedging", "stuck", "slip", "debris", "wrong_part")
STUCK_MM = 4.0  # a part that came this close to its seat is stuck above it, one further up is wedged
SLIP_MM = 1.0  # a part that moved this far in the gripper has slipped


@dataclass(frozen=True, slots=True)
class Insertion:
    """One simulated insertion and its truth.

    trace : (1000,) or (6, 1000) float32; newtons, and newton metres for the three torques.
    success : whether the final height is within the tolerance; nothing else enters the label.
    cause : of a failure, one of `CAUSES`; `"none"` for a success.
    height_mm : of the part's top over its nominal seated height.
    conditions, sensor : what was drawn.
    """

    trace: NDArray[np.float32]
    success: bool
    cause: str
    height_mm: float
    conditions: Conditions
    sensor: SensorFaults


def insert_once(
    parameters: CellParameters, seed: int, cycle: int, channels: str = "z", time_step_s: float = TIME_STEP_S
) -> Insertion:
    """Simulate one cycle. The same `parameters`, `seed` and `cycle` give the same insertion, in any order or process.

    channels : `"z"` for the z-force, `"all"` for force x, y, z and torque x, y, z.
    time_step_s : of the physics.
    """
    world_rng, sensor_rng, _ = streams(seed, cycle)
    conditions = draw_conditions(parameters, world_rng)
    pushed = push(conditions, time_step_s)
    faults = draw_sensor(parameters, sensor_rng)
    reading = read_sensor(pushed.wrench, faults, parameters, sensor_rng)
    success = abs(pushed.height_mm) <= parameters.height_tolerance_mm
    return Insertion(
        trace=reading[2] if CHANNELS[channels] == 1 else reading,
        success=success,
        cause="none" if success else diagnose(conditions, pushed),
        height_mm=pushed.height_mm,
        conditions=conditions,
        sensor=faults,
    )


def diagnose(conditions: Conditions, pushed: Push) -> str:
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


def streams(seed: int, cycle: int) -> tuple[np.random.Generator, np.random.Generator, np.random.Generator]:
    """Independent streams of one cycle: for the world, for the sensor, and for what the line notices afterwards."""
    world, sensor, line = np.random.SeedSequence(entropy=seed, spawn_key=(cycle,)).spawn(3)
    return np.random.default_rng(world), np.random.default_rng(sensor), np.random.default_rng(line)
