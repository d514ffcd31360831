"""The physics of one insertion: `push` builds gripper, part and fixture in MuJoCo and pushes once.
`cell_xml` writes the model in MuJoCo's XML (MJCF); the result is a `Push` with the true force,
the part's height and its slip. `insert_once` uses it.

Lengths inside MuJoCo are metres. The rim of the fixture is at z = 0 and its seat at z = -DEPTH_MM.
The hole is built from boxes, because MuJoCo replaces colliding meshes by their convex hulls, which
would close it.

References
----------
Todorov, Erez and Tassa (2012), MuJoCo: A physics engine for model-based control, IROS.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import DengineError, SettingError, expect, instead
from ...records import Floats
from .conditions import RATE_HZ, SAMPLES, Conditions

TIME_STEP_S = 0.0005
DEPTH_MM = 12.0
WIDTH_MM = 16.0  # side of a correct part, which is square
LENGTH_MM = 40.0
PROTRUSION_MM = 30.0  # a correct part nominally sticks out of the gripper by this much
_WALL_MM = 14.0
_BAND_N = 8.0  # the push slows down over the last newtons before its limit
_SETTLE_SAMPLES = 40


@dataclass(frozen=True, slots=True)
class Push:
    """Result of one push.

    Attributes
    ----------
    force : array of float64, shape (1000,)
        Force along z in newtons that a sensor without faults would read; pushing is positive.
    height_mm : float
        Height of the part's top above its nominal seated height; without a part -40.
    slip_mm : float
        How far the part slid up in the gripper; without a part 0.
    """

    force: Floats
    height_mm: float
    slip_mm: float


def push(conditions: Conditions, time_step_s: float = TIME_STEP_S) -> Push:
    """Lower the gripper with the part into the fixture for 2 s; return what came of it.

    The gripper goes down to a target below the floor of the hole, and moves back while the force is
    above `conditions.force_limit_n`. The force is recorded at 500 Hz. The simulation has no
    randomness.

    Parameters
    ----------
    conditions : Conditions
    time_step_s : float
        Step of the physics in seconds; it must divide 2 ms.

    Returns
    -------
    Push
        The force, 1000 samples in newtons, the height of the part's top above its nominal seated
        height, and how far the part slid up in the gripper, in mm; -40 and 0 if the grasp missed
        the part.

    Raises
    ------
    DengineError
        If MuJoCo is not installed.
    SettingError
        For a step that does not divide 2 ms (within a relative error of 1e-9), and for sizes,
        masses and stiffnesses that MuJoCo refuses.
    """
    with instead(
        DengineError,
        "Expected MuJoCo for the simulated cell",
        ImportError,
        do="pip install dengine[sim]",
    ):
        import mujoco
    steps = round(1 / RATE_HZ / time_step_s) if time_step_s > 0 else 0
    expect(
        math.isclose(steps * time_step_s, 1 / RATE_HZ),
        "a time step in seconds that divides 2 ms",
        time_step_s,
        "take 0.0005 or half of it",
    )
    with instead(
        SettingError,
        "Expected sizes, masses and springs above zero, MuJoCo refuses these",
        ValueError,
    ):
        model = mujoco.MjModel.from_xml_string(cell_xml(conditions, time_step_s))
    data = mujoco.MjData(model)
    force = _drive(mujoco, model, data, conditions, steps)
    if conditions.fault == "missed_grasp":
        return Push(force, height_mm=-LENGTH_MM, slip_mm=0.0)
    return Push(
        force,
        height_mm=1000 * float(data.site("top").xpos[2]) - (LENGTH_MM - DEPTH_MM),
        slip_mm=1000 * float(data.joint("in_hand").qpos[0]),
    )


def _drive(mujoco: Any, model: Any, data: Any, conditions: Conditions, steps: int) -> Floats:
    """Let the simulated gripper push; return the force (1000,) in newtons, at 500 Hz.

    `mujoco` is the module, `model` and `data` are its model and its state, which is advanced in
    place, and `steps` is the number of physics steps per sample. The force after 40 samples at
    rest, with the part in the gripper, counts as zero; pushing is positive. The conditions say when
    the gripper starts, how fast it is, how far it goes, and the limit of the force. If the newest
    sample is less than 8 N below this limit, the push slows down; if it is above the limit, the
    gripper moves back.
    """
    mujoco.mj_step(model, data, _SETTLE_SAMPLES * steps)
    settled = float(data.sensordata[2])
    travel_m = (
        conditions.gap_mm + conditions.protrusion_mm + DEPTH_MM + conditions.overtravel_mm
    ) / 1000
    period_s = 1 / RATE_HZ
    delay_samples = conditions.delay_s * RATE_HZ
    target_m = 0.0
    force = np.empty(SAMPLES)
    for sample in range(SAMPLES):
        if sample >= delay_samples:
            room = (conditions.force_limit_n - force[sample - 1]) / _BAND_N if sample else 1.0
            target_m += min(1.0, max(-1.0, room)) * conditions.speed_mm_s / 1000 * period_s
        data.ctrl[0] = -min(target_m, travel_m)
        mujoco.mj_step(model, data, steps)
        force[sample] = settled - data.sensordata[2]  # pushing is positive
    return force


def cell_xml(c: Conditions, time_step_s: float) -> str:
    """Return the MuJoCo model of the whole robot cell under the conditions `c`, as XML (MJCF).

    It has the fixture, the carriage, which a drive moves up and down, the elastic wrist with the
    force sensor, and the part, unless the grasp missed it. `time_step_s` is the step of the physics
    in seconds.
    """
    tool_z = (c.gap_mm + c.protrusion_mm + PROTRUSION_MM) / 1000 + 0.06
    lateral = _spring(1000 * c.lateral_n_mm, 1.0)
    axial = _spring(1000 * c.axial_n_mm, 1.0)
    angular = _spring(c.angular_nm_rad, 0.004)
    return f"""
<mujoco model="simulated insertion">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{time_step_s}" cone="elliptic" impratio="10" integrator="implicitfast"
          iterations="30"/>
  <default>
    <geom solref="0.002 1" solimp="0.99 0.999 0.0001" friction="{c.friction} 0.001 0.0001"
          condim="3"/>
  </default>
  <worldbody>
    {_fixture_xml(c)}
    <body name="carriage" pos="0 0 {tool_z}" gravcomp="1">
      <joint name="drive" type="slide" axis="0 0 1" damping="20"/>
      <inertial pos="0 0 0" mass="4" diaginertia="0.02 0.02 0.02"/>
      <body name="wrist" gravcomp="1">
        <joint type="slide" axis="1 0 0" {lateral}/>
        <joint type="slide" axis="0 1 0" {lateral}/>
        <joint type="slide" axis="0 0 1" {axial}/>
        <joint type="hinge" axis="1 0 0" {angular}/>
        <joint type="hinge" axis="0 1 0" {angular}/>
        <joint type="hinge" axis="0 0 1" {angular}/>
        <inertial pos="0 0 0" mass="0.2" diaginertia="0.0003 0.0003 0.0003"/>
        <body name="tool" gravcomp="1">
          <inertial pos="0 0 -0.03" mass="0.6" diaginertia="0.0006 0.0006 0.0003"/>
          <site name="sensor"/>
          {_part_xml(c)}
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="drive" kp="80000" kv="1200" timeconst="0.01"/>
  </actuator>
  <sensor><force site="sensor"/></sensor>
</mujoco>"""


def _spring(stiffness: float, inertia: float) -> str:
    """Return a spring's attributes in MJCF; its viscous damping is 0.6 of the critical damping."""
    damping = 2 * 0.6 * math.sqrt(stiffness * inertia)
    return f'stiffness="{stiffness}" damping="{damping}"'


def _part_xml(c: Conditions) -> str:
    """Return the part in the gripper as a body of MuJoCo, a text in its XML (MJCF).

    It is "" if the grasp missed the part. Dry friction holds the part in the gripper until the
    force of the push exceeds `c.grip_n` newtons; then it slides, by at most about 12 mm up or down.
    `c` are the conditions. `push` reads the joint "in_hand" and the site "top". Angles in the text
    are in radians (see `_wall_xml`).
    """
    if c.fault == "missed_grasp":
        return ""
    half = (WIDTH_MM + c.extra_width_mm) / 2000
    length = (LENGTH_MM + c.extra_length_mm) / 1000
    tip = -(PROTRUSION_MM + c.extra_length_mm / 2) / 1000
    tilt_x, tilt_y, yaw = (math.radians(angle) for angle in (c.tilt_x_deg, c.tilt_y_deg, c.yaw_deg))
    return f"""
          <body name="part" pos="{c.offset_x_mm / 1000} {c.offset_y_mm / 1000} -0.06"
                euler="{tilt_x} {tilt_y} {yaw}">
            <joint name="in_hand" type="slide" axis="0 0 1" frictionloss="{c.grip_n}"
                   range="-0.012 0.012" damping="20" solreffriction="0.002 1"
                   solimpfriction="0.9999 0.9999 0.001" solreflimit="0.002 1"/>
            <geom type="box" size="{half} {half} {length / 2}" pos="0 0 {tip + length / 2}"
                  mass="{c.part_mass_kg}"/>
            <site name="top" pos="0 0 {tip + length}"/>
          </body>"""


def _fixture_xml(c: Conditions) -> str:
    """Return the fixture of the MuJoCo model as a text in its XML (MJCF).

    It has four walls with a chamfer of 45° around a square hole, a floor, and debris, a soft box on
    the floor, only if its thickness in the conditions `c` is above 0. The rim is at z = 0. Angles
    in the text are in radians (see `_wall_xml`).
    """
    half = (WIDTH_MM + c.clearance_mm) / 2000
    depth = DEPTH_MM / 1000
    chamfer = c.chamfer_mm / 1000
    chip = c.debris_mm / 2000
    parts = [
        *(_wall_xml(side, half, chamfer, depth) for side in range(4)),
        f'<geom type="box" size="0.03 0.03 0.005" pos="0 0 {-depth - 0.005}"/>',
    ]
    if c.debris_mm > 0:
        position = f"{c.debris_x_mm / 1000} {c.debris_y_mm / 1000} {-depth + chip}"
        parts.append(
            f'<geom type="box" size="0.003 0.003 {chip}" pos="{position}" '
            f'solref="{c.debris_softness_s} 1" priority="1"/>'
        )
    return "\n".join(parts)


def _wall_xml(side: int, half: float, chamfer: float, depth: float) -> str:
    """Return one wall of the fixture's square hole as a text in MuJoCo's XML (MJCF).

    A wall is three boxes, one of which is the chamfer. Wall 0 is at +x; wall `side` (0 to 3) is
    turned by `side` quarter turns about z. The half width `half` of the hole, the width of the
    chamfer and the depth of the hole are in metres. The rim is at z = 0. Angles in the text are in
    radians, so the model needs MuJoCo's `<compiler angle="radian"/>`.
    """
    wall = _WALL_MM / 1000
    reach = half + chamfer + wall
    face = chamfer / math.sqrt(2)  # half the length of the sloping face
    thick = 0.004
    slope_x = half + chamfer / 2 + thick / math.sqrt(2)
    slope_z = -chamfer / 2 - thick / math.sqrt(2)
    low = (depth - chamfer) / 2
    return f"""
    <body euler="0 0 {side * math.pi / 2}">
      <geom type="box" size="{(reach - half) / 2} {reach} {low}"
            pos="{(reach + half) / 2} 0 {-chamfer - low}"/>
      <geom type="box" size="{wall / 2} {reach} {chamfer / 2}"
            pos="{reach - wall / 2} 0 {-chamfer / 2}"/>
      <geom type="box" size="{face} {half + chamfer} {thick}" pos="{slope_x} 0 {slope_z}"
            euler="0 {-math.pi / 4} 0"/>
    </body>"""
