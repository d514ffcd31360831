"""The simulated cell keeps the cell protocol, its clock, and its physics."""

from dataclasses import asdict, replace
from importlib.resources import files

import numpy as np
import pytest

pytest.importorskip("mujoco")

from dengine.cells.simulation.cell import SimulatedCell, SimulatedInsertion, insert_once
from dengine.cells.simulation.conditions import (
    SCENARIOS,
    CellParameters,
    Conditions,
    draw_conditions,
    find_scenario,
)
from dengine.cells.simulation.generate import save_insertions, simulate
from dengine.cells.simulation.world import push
from dengine.errors import DengineError, SettingError
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


def test_a_well_aligned_part_meets_the_bottom_late_and_one_beside_the_hole_rests_on_the_rim() -> (
    None
):
    pushed = push(good())
    assert abs(pushed.height_mm) < 0.5
    force = pushed.force
    assert np.abs(force[:400]).max() < 3
    assert 8 < force[-50:].mean() < 41
    beside = push(good(offset_x_mm=5.0))
    assert beside.height_mm > 11
    assert beside.force[-50:].mean() == pytest.approx(40.0, abs=2.0)


def traces(insertions: list[SimulatedInsertion]) -> np.ndarray:
    return np.stack([insertion.trace for insertion in insertions])


def test_a_trace_depends_on_seed_and_cycle_only() -> None:
    few, many = traces(simulate(3, seed=9, n_jobs=1)), traces(simulate(6, seed=9, n_jobs=2))
    np.testing.assert_array_equal(few, many[:3])
    assert not np.array_equal(few, traces(simulate(3, seed=10, n_jobs=1)))


def test_the_cell_still_makes_the_bundled_traces() -> None:
    with (files("dengine") / "data" / "insertion.npz").open("rb") as file, np.load(file) as stored:
        bundled, cycles, seed = (
            stored["X"][:5] * stored["scale"],
            stored["cycle"][:5],
            int(stored["seed"]),
        )
    created = np.stack([insert_once(CellParameters(), seed, int(cycle)).trace for cycle in cycles])
    assert (
        np.median(np.abs(created - bundled)) < 0.02
    )  # N; another processor may differ in the last digits


def test_the_clock_charges_cycles_verifications_and_stops() -> None:
    cell = SimulatedCell(replace(ALWAYS_MISSED, unreported_share=0.0))
    cell.insert()
    assert not cell.verify()
    for again in (cell.verify, cell.proceed, cell.reject):  # a part is taken once
        with pytest.raises(DengineError, match=r"insert\(\) before"):
            again()
    cell.insert()
    assert cell.proceed() is Outcome.STOPPED
    assert cell.clock == 47 + 5 + 47 + 120
    cell = SimulatedCell(ALWAYS_GOOD)
    assert cell.insert().shape == (1000,)
    cell.reject()
    cell.insert()
    cell.verify()
    assert cell.clock == 47 + 47 + 5


def test_scenarios_change_what_they_say_and_nothing_else() -> None:
    base = CellParameters()
    late = {name: asdict(scenario(base, 99, 100)) for name, scenario in SCENARIOS.items()}
    changed = {
        name: {key for key, value in asdict(base).items() if item[key] != value}
        for name, item in late.items()
    }
    variant = {"part_mass_kg", "clearance_mm", "chamfer_mm"}
    assert changed == {
        "nominal": set(),
        "wear": {"friction"},
        "variant": variant,
        "bias_jump": {"bias_offset_n"},
    }
    assert SCENARIOS["wear"](base, 99, 100).friction[0] == pytest.approx(base.friction[0] + 0.35)
    for name in ("variant", "bias_jump"):
        assert SCENARIOS[name](base, 49, 100) == base


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (lambda: find_scenario("rain"), "nominal, wear, variant, bias_jump"),
        (lambda: simulate(0), "at least 1"),
        (lambda: push(good(), time_step_s=0.0007), "divides 2 ms"),
    ],
)
def test_a_bad_setting_says_what_was_expected(bad: object, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        bad()  # type: ignore[operator]


def test_saved_traces_come_back_within_one_step(tmp_path) -> None:
    created = simulate(4, seed=6, n_jobs=1)
    path = save_insertions(tmp_path / "traces.npz", created)
    with np.load(path, allow_pickle=False) as saved:
        assert (saved["X"].dtype, saved["X"].shape) == (np.int16, (4, 1000))
        np.testing.assert_allclose(
            saved["X"] * saved["scale"], traces(created), atol=0.51 * float(saved["scale"].max())
        )
        np.testing.assert_array_equal(saved["y"], [item.success for item in created])
        assert float(saved["rate_hz"]) == 500
