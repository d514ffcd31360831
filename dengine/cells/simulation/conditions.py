"""What varies from one simulated insertion to the next: settings with their units, one cycle's draw, and scenarios."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from ...errors import expect

Range = tuple[float, float]  # (low, high) of a uniform draw

SAMPLES = 1000
RATE_HZ = 500.0
FAULTS = ("missed_grasp", "weak_grip", "debris", "wrong_part")
_PROBABILITIES = {"silent_share", "confirm_share", *FAULTS}
_SIGNED = {"bias_n", "drift_n", "bias_offset_n"}


@dataclass(frozen=True, slots=True)
class CellParameters:
    """Every setting of the simulated cell. A `Range` is drawn uniformly each cycle, a `_sd` normally around zero.

    **Times of the line** (seconds)
    cycle_s, verify_s, stop_s : one pick and insertion; one height check; one system stop, operator included.
    **What the cell notices** (probabilities)
    silent_share : a failed part that was passed on and does not stop the system.
    confirm_share : a good part that was passed on and is confirmed as good later in the line.
    **Height check** (millimetres)
    height_tolerance_mm : a part whose top is this close to its nominal height is a success.
    **Grasp**
    offset_sd_mm, tilt_sd_deg, yaw_sd_deg : where the part sits in the gripper, laterally and in rotation.
    protrusion_sd_mm : how far it sticks out, about the nominal.
    grip_n : pull at which the part slips in the gripper; weak_grip_n : the same, for a poor grasp.
    **Part and fixture**
    part_mass_kg, length_sd_mm : of a right part.
    clearance_mm : hole width less part width. chamfer_mm : width of the hole's 45 degree chamfer.
    friction : Coulomb coefficient between part and fixture.
    extra_length_mm, extra_width_mm : how a wrong part differs, before the sign is drawn.
    debris_mm : thickness of what lies on the fixture's floor.
    **Robot**
    gap_mm : from part to rim when the recording starts. delay_s : from then until the robot moves.
    speed_mm_s, force_limit_n, overtravel_mm : of the push; overtravel is how far below the seat it aims.
    lateral_n_mm, axial_n_mm, angular_nm_rad : springs of the wrist.
    **Faults** (probability that a cycle is drawn with this fault; what comes of it is up to the physics)
    missed_grasp, weak_grip, debris, wrong_part.
    **Sensor**
    noise_n, ripple_n, ripple_hz : white noise and gear ripple. bias_n, drift_n : offset, and its change over a trace.
    step_n : quantisation. dropped_share : samples lost, the last one is held. bandwidth_hz : low-pass filter.
    bias_offset_n : a constant on top of every bias; zero but in the `bias_jump` scenario.
    """

    cycle_s: float = 47.0
    verify_s: float = 5.0
    stop_s: float = 120.0

    silent_share: float = 0.1
    confirm_share: float = 0.0

    height_tolerance_mm: float = 0.5

    offset_sd_mm: float = 0.92
    tilt_sd_deg: float = 1.2
    yaw_sd_deg: float = 0.6
    protrusion_sd_mm: float = 0.45
    grip_n: Range = (70.0, 160.0)
    weak_grip_n: Range = (6.0, 30.0)

    part_mass_kg: Range = (0.08, 0.30)
    length_sd_mm: float = 0.08
    clearance_mm: Range = (0.10, 0.45)
    chamfer_mm: Range = (0.8, 2.0)
    friction: Range = (0.10, 0.38)
    extra_length_mm: Range = (0.5, 6.0)
    extra_width_mm: Range = (0.2, 1.2)
    debris_mm: Range = (0.2, 8.0)

    gap_mm: Range = (3.5, 5.5)
    delay_s: Range = (0.0, 0.10)
    speed_mm_s: Range = (12.7, 14.3)
    force_limit_n: Range = (25.0, 65.0)
    overtravel_mm: Range = (1.1, 2.9)
    lateral_n_mm: Range = (2.0, 8.0)
    axial_n_mm: Range = (12.0, 30.0)
    angular_nm_rad: Range = (5.0, 25.0)

    missed_grasp: float = 0.03
    weak_grip: float = 0.07
    debris: float = 0.045
    wrong_part: float = 0.025

    noise_n: Range = (0.15, 0.60)
    ripple_n: Range = (0.0, 0.5)
    ripple_hz: Range = (8.0, 40.0)
    bias_n: Range = (-2.0, 2.0)
    drift_n: Range = (-1.0, 1.0)
    step_n: Range = (0.02, 0.15)
    dropped_share: Range = (0.0, 0.02)
    bandwidth_hz: float = 90.0
    bias_offset_n: float = 0.0

    def __post_init__(self) -> None:
        for name in (each.name for each in fields(self)):
            value = getattr(self, name)
            low, high = value if isinstance(value, tuple) else (value, value)
            expect(low <= high, f"{name} as (low, high) with low <= high", value, "swap them")
            probable = name not in _PROBABILITIES or 0 <= low <= 1
            expect(probable, f"{name} as a probability from 0 to 1", value, "give a share of 1")
            expect(
                name in _SIGNED or low >= 0,
                f"{name} to be at least 0",
                value,
                "the unit is in its name",
            )
        faults = self.missed_grasp + self.weak_grip + self.debris + self.wrong_part
        expect(faults <= 1, "fault probabilities that sum to at most 1", faults, "lower one")


@dataclass(frozen=True, slots=True)
class Conditions:
    """What one insertion meets. Units are in the names; `fault` is what was drawn, not what came of it.

    debris_x_mm, debris_y_mm : where the debris lies, from the hole's centre. debris_softness_s : contact time constant.
    extra_length_mm, extra_width_mm : of this part against the nominal one.
    """

    fault: str
    offset_x_mm: float
    offset_y_mm: float
    tilt_x_deg: float
    tilt_y_deg: float
    yaw_deg: float
    protrusion_mm: float
    grip_n: float
    part_mass_kg: float
    extra_length_mm: float
    extra_width_mm: float
    clearance_mm: float
    chamfer_mm: float
    friction: float
    debris_mm: float
    debris_x_mm: float
    debris_y_mm: float
    debris_softness_s: float
    gap_mm: float
    delay_s: float
    speed_mm_s: float
    force_limit_n: float
    overtravel_mm: float
    lateral_n_mm: float
    axial_n_mm: float
    angular_nm_rad: float


# What is drawn by a setting of another name, or in a range of its own; all else goes by its own name.
_DRAWN_BY: dict[str, str | Range] = {
    **dict.fromkeys(("offset_x_mm", "offset_y_mm"), "offset_sd_mm"),
    **dict.fromkeys(("tilt_x_deg", "tilt_y_deg"), "tilt_sd_deg"),
    "yaw_deg": "yaw_sd_deg",
    "protrusion_mm": "protrusion_sd_mm",
    "extra_length_mm": "length_sd_mm",
    **dict.fromkeys(("debris_x_mm", "debris_y_mm"), (-5.0, 5.0)),
    "debris_softness_s": (0.003, 0.02),
}


def draw_conditions(parameters: CellParameters, rng: np.random.Generator) -> Conditions:
    """Draw one insertion. Every quantity is drawn in every cycle, so a change of one leaves the others as they were."""
    p = parameters

    def drawn(setting: str | Range) -> float:
        value = getattr(p, setting) if isinstance(setting, str) else setting
        return float(rng.uniform(*value) if isinstance(value, tuple) else rng.normal(0.0, value))

    usual = {"fault": "none", "extra_width_mm": 0.0, "debris_mm": 0.0}
    names = [
        each.name for each in fields(Conditions) if each.name not in usual
    ]  # in the order in which they are drawn
    right = Conditions(**usual, **{name: drawn(_DRAWN_BY.get(name, name)) for name in names})  # type: ignore[arg-type]
    weak_grip_n, debris_mm = drawn("weak_grip_n"), drawn("debris_mm")
    extra_length_mm = drawn("extra_length_mm") * float(rng.choice((-1, 1)))
    extra_width_mm = drawn("extra_width_mm") * float(rng.choice((-1, 1)))
    changes: dict[str, dict[str, float]] = {
        "weak_grip": {"grip_n": weak_grip_n},
        "debris": {"debris_mm": debris_mm},
        "wrong_part": {"extra_length_mm": extra_length_mm, "extra_width_mm": extra_width_mm},
    }
    shares = [p.missed_grasp, p.weak_grip, p.debris, p.wrong_part]
    fault = str(rng.choice(["none", *FAULTS], p=[1 - sum(shares), *shares]))
    return replace(right, fault=fault, **changes.get(fault, {}))


# (parameters, cycle, cycles) -> the parameters of that cycle
Scenario = Callable[[CellParameters, int, int], CellParameters]


def nominal(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Nothing changes."""
    return parameters


def wear(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """The tool wears: friction grows in proportion to the cycles done, by 0.35 in all."""
    low, high = parameters.friction
    grown = 0.35 * min(1.0, cycle / max(1, cycles - 1))
    return replace(parameters, friction=(low + grown, high + grown))


def variant(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Half way a new part variant comes: heavier, a tighter fit, a smaller chamfer."""
    if cycle < cycles // 2:
        return parameters
    low, high = parameters.part_mass_kg
    return replace(
        parameters,
        part_mass_kg=(2.5 * low, 2.5 * high),
        clearance_mm=(0.04, 0.16),
        chamfer_mm=(0.5, 1.0),
    )


def bias_jump(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Half way the force sensor's offset jumps by 8 N and stays; the world is as it was."""
    return (
        parameters
        if cycle < cycles // 2
        else replace(parameters, bias_offset_n=parameters.bias_offset_n + 8.0)
    )


SCENARIOS: dict[str, Scenario] = {
    "nominal": nominal,
    "wear": wear,
    "variant": variant,
    "bias_jump": bias_jump,
}


def find_scenario(name: str) -> Scenario:
    """The scenario of this name."""
    expect(name in SCENARIOS, f"a scenario of {', '.join(SCENARIOS)}", name, "choose one of these")
    return SCENARIOS[name]
