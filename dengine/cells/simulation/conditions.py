"""Conditions of a simulated insertion: the cell's settings, one cycle's draw, and scenarios.
`CellParameters` says from which ranges `draw_conditions` draws the `Conditions` of a cycle; a
scenario (`nominal`, `wear`, `variant`, `bias_jump`) is a function that changes the parameters in
the course of a run. Units are in the names. `SimulatedCell` and `simulate` use them.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

from numpy.random import Generator

from ...errors import expect

Range = tuple[float, float]  # (low, high) of a uniform draw

SAMPLES = 1000
RATE_HZ = 500.0
FAULTS = ("missed_grasp", "weak_grip", "debris", "wrong_part")


@dataclass(frozen=True, slots=True)
class CellParameters:
    """Settings of the simulated cell.

    A `Range` (low, high) is drawn uniformly in each cycle; a value named `_sd` is the standard
    deviation of a normal draw around zero. Probabilities are from 0 to 1.

    Parameters
    ----------
    cycle_s, verify_s, stop_s : float
        Seconds for a pick and insertion, for a height check, and for a line stop, operator
        included.
    unreported_share : float
        Probability that a bad part which was passed on does not stop the line.
    height_tolerance_mm : float
        A part is good if the height of its top differs from the nominal one by at most this.
    offset_sd_mm, tilt_sd_deg, yaw_sd_deg : float
        Lateral offset and rotations of the part in the gripper.
    protrusion_sd_mm : float
        Deviation from the length by which a part nominally sticks out of the gripper.
    grip_n, weak_grip_n : Range
        Push at which the part slips in the gripper, and the same for a poor grasp.
    part_mass_kg, length_sd_mm : Range, float
        Mass of a part, and deviation of a correct part's length.
    clearance_mm : Range
        Width of the hole minus width of the part.
    chamfer_mm : Range
        Width of the hole's chamfer of 45 degrees.
    friction : Range
        Coulomb coefficient between part and fixture.
    extra_length_mm, extra_width_mm : Range
        Deviations of a wrong part, without their signs, which are drawn too.
    debris_mm : Range
        Thickness of debris on the fixture's floor.
    gap_mm : Range
        Distance from the part to the rim at the start of the recording.
    delay_s : Range
        Time from then until the robot moves.
    speed_mm_s, force_limit_n, overtravel_mm : Range
        Speed and limit of the push, and how far below the seat its target is.
    lateral_n_mm, axial_n_mm, angular_nm_rad : Range
        Stiffness of the wrist.
    missed_grasp, weak_grip, debris, wrong_part : float
        Probabilities of the faults. Whether a fault makes a bad part follows from the physics.
    noise_n, ripple_n, ripple_hz : Range
        White noise of the sensor, and ripple of the gears.
    bias_n, drift_n : Range
        Offset of the sensor, and its change during a trace.
    step_n : Range
        Quantisation.
    dropped_share : Range
        Share of the samples that are lost; the last one is held.
    bandwidth_hz : float
        Of the sensor's low-pass filter.
    bias_offset_n : float
        Added to every bias; zero but in the scenario "bias_jump".
    """

    cycle_s: float = 47.0
    verify_s: float = 5.0
    stop_s: float = 120.0

    unreported_share: float = 0.1

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


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of one insertion, as drawn.

    Attributes
    ----------
    fault : str
        The fault that was drawn, one of `FAULTS`, or "none". It need not have an effect.
    extra_length_mm, extra_width_mm : float
        Deviations of this part from the nominal one.
    debris_x_mm, debris_y_mm : float
        Position of the debris, from the hole's centre.
    debris_softness_s : float
        Time constant of the contact with the debris.

    The other fields are values of the settings of `CellParameters` with the same name.
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


# Fields of `Conditions` that are drawn by a setting of another name, or in a fixed range.
_DRAWN_BY: dict[str, str | Range] = {
    "offset_x_mm": "offset_sd_mm",
    "offset_y_mm": "offset_sd_mm",
    "tilt_x_deg": "tilt_sd_deg",
    "tilt_y_deg": "tilt_sd_deg",
    "yaw_deg": "yaw_sd_deg",
    "protrusion_mm": "protrusion_sd_mm",
    "extra_length_mm": "length_sd_mm",
    "debris_x_mm": (-5.0, 5.0),
    "debris_y_mm": (-5.0, 5.0),
    "debris_softness_s": (0.003, 0.02),
}


def draw_conditions(parameters: CellParameters, rng: Generator) -> Conditions:
    """Draw the conditions of one insertion, its fault included; `rng` is advanced.

    A range is drawn uniformly; a setting with `_sd` in its name is the standard deviation of a
    normal draw around 0. Every quantity is drawn each time, even if it is not used, so that another
    range for one quantity does not change the others. At most one fault is drawn (missed grasp,
    weak grip, debris or wrong part); its values replace the normal ones, for example a weak grip
    the normal grip. A missed grasp replaces no value: only the field `fault` says so.

    Parameters
    ----------
    parameters : CellParameters
    rng : numpy.random.Generator

    Returns
    -------
    Conditions

    Raises
    ------
    ValueError
        For a range whose first number is larger than its second, a negative standard deviation, or
        probabilities of faults that are negative or add up to more than 1.
    OverflowError
        For a range that is not finite.
    """

    def draw(setting: str | Range) -> float:
        """Draw a value: by a setting's name, or in a range.

        A range is drawn uniformly, a single number is the standard deviation of a normal draw
        around 0.
        """
        value = getattr(parameters, setting) if isinstance(setting, str) else setting
        return rng.uniform(*value) if isinstance(value, tuple) else rng.normal(0.0, value)

    without_fault = {"fault": "none", "extra_width_mm": 0.0, "debris_mm": 0.0}
    # The values are drawn in the order of the fields.
    values = {
        field.name: draw(_DRAWN_BY.get(field.name, field.name))
        for field in fields(Conditions)
        if field.name not in without_fault
    }
    normal = Conditions(**without_fault, **values)  # type: ignore[arg-type]
    changes: dict[str, dict[str, float]] = {
        "weak_grip": {"grip_n": draw("weak_grip_n")},
        "debris": {"debris_mm": draw("debris_mm")},
        "wrong_part": {
            name: draw(name) * float(rng.choice((-1, 1)))
            for name in ("extra_length_mm", "extra_width_mm")
        },
    }
    shares = [getattr(parameters, fault) for fault in FAULTS]
    fault = str(rng.choice(["none", *FAULTS], p=[1 - sum(shares), *shares]))
    return replace(normal, fault=fault, **changes.get(fault, {}))


# Called with the parameters, a cycle and the number of cycles; returns the parameters of the cycle.
Scenario = Callable[[CellParameters, int, int], CellParameters]


def nominal(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Return the parameters unchanged."""
    return parameters


def wear(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Return the parameters with more friction in later cycles, because the tool wears.

    Both ends of the range of the friction grow linearly, by 0.35 from cycle 0 to the last of the
    `cycles`; then they stay.
    """
    low, high = parameters.friction
    grown = 0.35 * min(1.0, cycle / max(1, cycles - 1))
    return replace(parameters, friction=(low + grown, high + grown))


def variant(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Return the parameters of a cycle: unchanged in the first half, then those of another part.

    `cycle` counts from 0, and `cycles` is their number; if it is odd, the first half is the smaller
    one. The other part is 2.5 times as heavy. Its clearance (width of the hole minus width of the
    part) will be drawn from 0.04 to 0.16 mm, and the chamfer of the hole from 0.5 to 1.0 mm,
    whatever the parameters say; both are smaller than by default. Nothing is drawn here.
    """
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
    """Return the parameters of a cycle; in the second half the force sensor reads 8 N more.

    `cycle` counts from 0, and `cycles` is their number; of an odd number the first half is the
    smaller one.
    """
    if cycle < cycles // 2:
        return parameters
    return replace(parameters, bias_offset_n=parameters.bias_offset_n + 8.0)


SCENARIOS: dict[str, Scenario] = {
    "nominal": nominal,
    "wear": wear,
    "variant": variant,
    "bias_jump": bias_jump,
}


def find_scenario(name: str) -> Scenario:
    """Return the scenario of this name, a function of (parameters, cycle, cycles).

    Raise SettingError for an unknown name.
    """
    expect(name in SCENARIOS, f"a scenario of {', '.join(SCENARIOS)}", name, "choose one of these")
    return SCENARIOS[name]
