"""What changes while the simulated cell runs: a scenario turns a cycle's number into that cycle's parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from ...errors import SettingError
from .parameters import CellParameters

# (parameters, cycle, cycles) -> the parameters of that cycle
Scenario = Callable[[CellParameters, int, int], CellParameters]

WEAR_FRICTION = 0.35  # added to the friction by the last cycle
VARIANT_MASS_FACTOR, VARIANT_CLEARANCE_MM, VARIANT_CHAMFER_MM = 2.5, (0.04, 0.16), (0.5, 1.0)
JUMP_N = 8.0


def nominal(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Nothing changes."""
    return parameters


def wear(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """The tool wears: friction grows in proportion to the cycles done."""
    low, high = parameters.friction
    grown = WEAR_FRICTION * min(1.0, cycle / max(1, cycles - 1))
    return replace(parameters, friction=(low + grown, high + grown))


def variant(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Half way a new part variant comes: heavier, a tighter fit, a smaller chamfer."""
    if cycle < cycles // 2:
        return parameters
    low, high = parameters.part_mass_kg
    return replace(
        parameters,
        part_mass_kg=(low * VARIANT_MASS_FACTOR, high * VARIANT_MASS_FACTOR),
        clearance_mm=VARIANT_CLEARANCE_MM,
        chamfer_mm=VARIANT_CHAMFER_MM,
    )


def bias_jump(parameters: CellParameters, cycle: int, cycles: int) -> CellParameters:
    """Half way the force sensor's offset jumps and stays; the world is as it was."""
    return parameters if cycle < cycles // 2 else replace(parameters, bias_offset_n=parameters.bias_offset_n + JUMP_N)


SCENARIOS: dict[str, Scenario] = {"nominal": nominal, "wear": wear, "variant": variant, "bias_jump": bias_jump}


def find_scenario(name: str) -> Scenario:
    """The scenario of this name."""
    if name not in SCENARIOS:
        raise SettingError(f"Expected a scenario of {', '.join(SCENARIOS)}; got {name!r}; choose one of these.")
    return SCENARIOS[name]


def first_change(name: str, cycles: int) -> int | None:
    """The number, from 1, of the first cycle that is not as at the beginning; None where nothing changes."""
    as_usual, change = CellParameters(), find_scenario(name)
    return next((i + 1 for i in range(cycles) if change(as_usual, i, cycles) != as_usual), None)
