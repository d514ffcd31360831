"""The simulated cell keeps the cell protocol, its clock, and its physics."""

from dataclasses import asdict, replace
from importlib.resources import files

import numpy as np
import pytest

pytest.importorskip("mujoco")

from dengine import load_dataset
from dengine.cells.simulation.cell import SimulatedCell, insert_once
from dengine.cells.simulation.conditions import (
    SCENARIOS,
    CellParameters,
    Conditions,
    draw_conditions,
)
from dengine.cells.simulation.generate import save_insertions, simulate
from dengine.cells.simulation.world import push
from dengine.errors import DengineError
from dengine.records import Outcome

NO_FAULTS = CellParameters(missed_grasp=0, weak_grip=0, debris=0, wrong_part=0)
ALWAYS_GOOD = replace(
    NO_FAULTS, offset_sd_mm=0.0, tilt_sd_deg=0.0, yaw_sd_deg=0.0, clearance_mm=(0.4, 0.4)
)
ALWAYS_MISSED = CellParameters(missed_grasp=1, weak_grip=0, debris=0, wrong_part=0)


def good(**changes: float | str) -> Conditions:
    """A well aligned part, but for these changes."""
    return replace(
        draw_conditions(ALWAYS_GOOD, np.random.default_rng(0)), force_limit_n=40.0, **changes
    )


def test_a_well_aligned_part_meets_the_bottom_late_and_one_beside_the_hole_rests_on_the_rim():
    pushed = push(good())
    assert abs(pushed.height_mm) < 0.5
    force = pushed.force
    assert np.abs(force[:400]).max() < 3
    assert 8 < force[-50:].mean() < 41
    beside = push(good(offset_x_mm=5.0))
    assert beside.height_mm > 11
    assert beside.force[-50:].mean() == pytest.approx(40.0, abs=2.0)


def traces(n: int, seed: int, n_jobs: int = 1) -> np.ndarray:
    return np.stack([item.trace for item in simulate(n, seed=seed, n_jobs=n_jobs)])


def test_a_trace_depends_on_seed_and_cycle_only():
    few = traces(3, 9)
    np.testing.assert_array_equal(few, traces(6, 9, n_jobs=2)[:3])
    assert not np.array_equal(few, traces(3, 10))


def test_the_cell_still_makes_the_bundled_traces():
    with (files("dengine") / "data" / "insertion.npz").open("rb") as file, np.load(file) as stored:
        bundled, cycles = stored["X"][:5] * stored["scale"], stored["cycle"][:5]
        seed = int(stored["seed"])
    created = [insert_once(CellParameters(), seed, int(cycle)).trace for cycle in cycles]
    # N; another processor may differ in the last digits
    assert np.median(np.abs(created - bundled)) < 0.02


def test_the_clock_charges_cycles_verifications_and_stops():
    cell = SimulatedCell(replace(ALWAYS_MISSED, unreported_share=0.0))
    cell.insert()
    assert not cell.verify()
    with pytest.raises(DengineError, match=r"insert\(\) before"):  # a part is taken once
        cell.proceed()
    cell.insert()
    assert cell.proceed() is Outcome.STOPPED
    assert cell.clock == 47 + 5 + 47 + 120
    cell = SimulatedCell(ALWAYS_GOOD)
    assert cell.insert().shape == (1000,)
    cell.reject()
    cell.insert()
    cell.verify()
    assert cell.clock == 47 + 47 + 5


def test_scenarios_change_what_they_say_and_nothing_else():
    base = CellParameters()
    changed = {"nominal": "", "bias_jump": "bias_offset_n", "wear": "friction"}
    changed |= {"variant": "part_mass_kg clearance_mm chamfer_mm"}
    assert SCENARIOS.keys() == changed.keys()
    for name, scenario in SCENARIOS.items():
        late = asdict(scenario(base, 99, 100))
        assert {key for key in late if late[key] != asdict(base)[key]} == {*changed[name].split()}
        assert name == "wear" or scenario(base, 49, 100) == base
    assert SCENARIOS["wear"](base, 99, 100).friction[0] == pytest.approx(base.friction[0] + 0.35)


def test_saved_traces_come_back_within_one_step(tmp_path):
    path = save_insertions(tmp_path / "traces.npz", simulate(4, seed=6, n_jobs=1))
    saved, step = load_dataset(path), 0.51 * float(np.load(path)["scale"].max())
    np.testing.assert_allclose(saved.X, traces(4, 6), atol=step)
    assert saved.y.tolist() == [item.success for item in simulate(4, seed=6, n_jobs=1)]
    assert saved.spec == SimulatedCell.spec
