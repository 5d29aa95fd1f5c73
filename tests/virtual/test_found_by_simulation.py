"""Schedules by which the fault simulator found defects, each named after its defect."""

from tests.virtual.schedule import Cell, Override, Schedule, ScriptDelay, Stall
from tests.virtual.simulation import run


def test_no_step_returns_a_state_that_stops_the_arms():
    """Seed 304: a step returned joint angles of NaN, and its record could not be read."""
    cell = Cell(seed=11, speed_factor=0.5, far=True, motion_s=0.41)
    outcome = run(Schedule(cell=cell, faults=(Override(arm="left", what="nan", at_s=0.28, duration_s=0.0201),)))
    assert not outcome.violations
    assert "not finite" in outcome.latched


def test_a_failed_start_leaves_no_program_running():
    """Seed 883: a controller reported no program while the control script ran, and no later start succeeded."""
    cell = Cell(again=True)
    outcome = run(Schedule(cell=cell, faults=(Override(arm="right", what="program", when="start", at_s=0.0),)))
    assert not outcome.violations
    assert "did not start" in outcome.error
    assert not outcome.latched
    assert outcome.moved


def test_an_episode_begins_without_a_step():
    """Seed 2483: the brake behind the last target of a path to the start led 0.03 mrad away from there."""
    cell = Cell(task="SyncCarry", family="e-series", plant="mild", seed=18, policy="scripted", motion_s=0.1)
    assert not run(Schedule(cell=cell)).violations


def test_no_waiting_program_holds_up_the_next():
    """Seed 2813: a program that a slow controller had not started yet kept later ones from starting."""
    cell = Cell(again=True)
    outcome = run(Schedule(cell=cell, faults=(ScriptDelay(arm="right", when="start", seconds=20.0, at_s=0.1),)))
    assert not outcome.violations
    assert outcome.moved


def test_a_stall_while_stopping_leads_to_no_two_targets_in_one_control_period():
    """Seed 3940: after a stall of 20 ms an arm's process sent an overdue target, and the next in the same period."""
    fault = Stall(process="left", when="end", at_s=0.0046, duration_s=0.02)
    outcome = run(Schedule(cell=Cell(), faults=(fault,)))
    assert not outcome.violations
    assert outcome.fired == 1
