"""One cycle's draw: the physical conditions under which one part is inserted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .parameters import CellParameters, Range

FAULTS = ("missed_grasp", "weak_grip", "debris", "wrong_part")


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


def draw_conditions(parameters: CellParameters, rng: np.random.Generator) -> Conditions:
    """Draw one insertion. Every quantity is drawn in every cycle, so a change of one leaves the others as they were."""
    p = parameters

    def uniform(span: Range) -> float:
        return float(rng.uniform(*span))

    def normal(sd: float) -> float:
        return float(rng.normal(0.0, sd))

    right = Conditions(
        fault="none",
        offset_x_mm=normal(p.offset_sd_mm),
        offset_y_mm=normal(p.offset_sd_mm),
        tilt_x_deg=normal(p.tilt_sd_deg),
        tilt_y_deg=normal(p.tilt_sd_deg),
        yaw_deg=normal(p.yaw_sd_deg),
        protrusion_mm=normal(p.protrusion_sd_mm),
        grip_n=uniform(p.grip_n),
        part_mass_kg=uniform(p.part_mass_kg),
        extra_length_mm=normal(p.length_sd_mm),
        extra_width_mm=0.0,
        clearance_mm=uniform(p.clearance_mm),
        chamfer_mm=uniform(p.chamfer_mm),
        friction=uniform(p.friction),
        debris_mm=0.0,
        debris_x_mm=uniform((-5.0, 5.0)),
        debris_y_mm=uniform((-5.0, 5.0)),
        debris_softness_s=uniform((0.003, 0.02)),
        gap_mm=uniform(p.gap_mm),
        delay_s=uniform(p.delay_s),
        speed_mm_s=uniform(p.speed_mm_s),
        force_limit_n=uniform(p.force_limit_n),
        overtravel_mm=uniform(p.overtravel_mm),
        lateral_n_mm=uniform(p.lateral_n_mm),
        axial_n_mm=uniform(p.axial_n_mm),
        angular_nm_rad=uniform(p.angular_nm_rad),
    )
    weak_grip_n, debris_mm = uniform(p.weak_grip_n), uniform(p.debris_mm)
    extra_length_mm = uniform(p.extra_length_mm) * float(rng.choice((-1, 1)))
    extra_width_mm = uniform(p.extra_width_mm) * float(rng.choice((-1, 1)))
    faults = {
        "none": right,
        "missed_grasp": replace(right, fault="missed_grasp"),
        "weak_grip": replace(right, fault="weak_grip", grip_n=weak_grip_n),
        "debris": replace(right, fault="debris", debris_mm=debris_mm),
        "wrong_part": replace(right, fault="wrong_part", extra_length_mm=extra_length_mm, extra_width_mm=extra_width_mm),
    }
    shares = [p.missed_grasp, p.weak_grip, p.debris, p.wrong_part]
    return faults[str(rng.choice(["none", *FAULTS], p=[1 - sum(shares), *shares]))]
