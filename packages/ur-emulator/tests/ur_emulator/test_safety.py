"""State machine of power, brakes and safety."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import scaled
from ur_core.errors import OperationRefusedError
from ur_core.protocol.modes import RobotMode, SafetyBits, SafetyMode
from ur_emulator.controller.safety import UNLOCK_TOO_EARLY, Demand, Safety
from ur_emulator.profile import Assumptions

TICK_S = 0.008


def passing(safety, seconds, *, at_rest=True):
    for _ in range(round(seconds / TICK_S)):
        safety.tick(TICK_S, at_rest=at_rest)


def test_power_and_brakes_take_their_time():
    assumed = Assumptions()
    safety = Safety(assumed, powered=False)
    assert safety.demand is Demand.STOP
    safety.release_brakes()  # does both
    assert safety.robot_mode == RobotMode.POWER_ON
    passing(safety, assumed.power_on_s - 0.02)
    assert safety.robot_mode == RobotMode.POWER_ON
    passing(safety, 0.04)
    assert safety.robot_mode == RobotMode.IDLE
    passing(safety, assumed.brake_release_s)
    assert safety.robot_mode == RobotMode.RUNNING
    assert safety.demand is Demand.NONE
    assert safety.may_move


def test_power_on_leaves_the_brakes_on():
    safety = Safety(Assumptions(), powered=False)
    safety.power_on()
    passing(safety, 5.0)
    assert safety.robot_mode == RobotMode.IDLE
    safety.release_brakes()
    passing(safety, 1.0)
    assert safety.robot_mode == RobotMode.RUNNING
    safety.power_off()
    assert safety.robot_mode == RobotMode.POWER_OFF


def test_a_protective_stop_is_not_unlocked_within_five_seconds():
    safety = Safety(Assumptions())
    safety.stop(SafetyMode.PROTECTIVE_STOP, "C204A1")
    assert safety.demand is Demand.PAUSE
    assert not safety.may_move
    passing(safety, 4.9)
    with pytest.raises(OperationRefusedError, match="5s"):
        safety.unlock_protective_stop()
    assert str(UNLOCK_TOO_EARLY)
    passing(safety, 0.2)
    safety.unlock_protective_stop()
    assert safety.safety_mode == SafetyMode.NORMAL
    assert safety.may_move


def test_the_primary_interface_may_wait_too():
    safety = Safety(Assumptions(primary_unlock_waits=True))
    safety.stop(SafetyMode.PROTECTIVE_STOP)
    with pytest.raises(OperationRefusedError, match="5s"):
        safety.unlock_protective_stop(primary=True)


def test_unlocking_does_not_end_other_stops():
    safety = Safety(Assumptions())
    safety.stop(SafetyMode.PROTECTIVE_STOP)
    safety.stop(SafetyMode.SAFEGUARD_STOP)
    passing(safety, 6.0)
    safety.unlock_protective_stop()
    assert safety.safety_mode == SafetyMode.SAFEGUARD_STOP
    assert not safety.may_move


@pytest.mark.parametrize("mode", [SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP])
def test_an_emergency_stop_takes_the_power_once_the_arm_stands(mode):
    safety = Safety(Assumptions())
    safety.stop(mode)
    assert safety.demand is Demand.STOP
    passing(safety, 0.1, at_rest=False)
    assert safety.robot_mode == RobotMode.RUNNING
    passing(safety, 0.1)
    assert safety.robot_mode == RobotMode.POWER_OFF
    assert safety.safety_bits & SafetyBits.EMERGENCY_STOPPED
    with pytest.raises(OperationRefusedError, match=mode.name):
        safety.power_on()
    safety.release(mode)
    assert safety.robot_mode == RobotMode.POWER_OFF  # releasing the button alone moves nothing
    safety.release_brakes()
    passing(safety, 2.0)
    assert safety.may_move


@pytest.mark.parametrize("mode", [SafetyMode.VIOLATION, SafetyMode.FAULT])
def test_a_violation_takes_a_restart(mode):
    safety = Safety(Assumptions())
    safety.stop(mode)
    passing(safety, 0.1)
    with pytest.raises(OperationRefusedError):
        safety.release_brakes()
    safety.restart()
    passing(safety, 0.5)
    assert safety.safety_mode == mode
    passing(safety, 1.0)
    assert safety.safety_mode == SafetyMode.NORMAL
    assert safety.robot_mode == RobotMode.POWER_OFF


@pytest.mark.parametrize("number", [10, 11, 12, 15, 21, 99, 255])
def test_numbers_that_nobody_knows_stop_the_arm(number):
    safety = Safety(Assumptions())
    safety.stop(number)
    assert safety.safety_mode == number
    assert safety.demand is Demand.PAUSE
    assert not safety.may_move
    assert safety.safety_bits & SafetyBits.STOPPED_DUE_TO_SAFETY
    safety.release(number)
    assert safety.may_move


def test_normal_is_no_stop():
    safety = Safety(Assumptions())
    for mode in (SafetyMode.NORMAL, SafetyMode.REDUCED):
        with pytest.raises(OperationRefusedError):
            safety.stop(mode)


def test_only_a_safeguard_stop_lets_programs_resume_by_themselves():
    safety = Safety(Assumptions())
    safety.stop(SafetyMode.SAFEGUARD_STOP)
    assert safety.resumes
    safety.stop(SafetyMode.PROTECTIVE_STOP)
    assert not safety.resumes
    other = Safety(Assumptions(safeguard_resumes=False))
    other.stop(SafetyMode.SAFEGUARD_STOP)
    assert not other.resumes


def test_assumptions_can_be_switched():
    safety = Safety(Assumptions(protective_stop_pauses=False))
    safety.stop(SafetyMode.PROTECTIVE_STOP)
    assert safety.demand is Demand.STOP
    safety = Safety(Assumptions(emergency_stop_pauses=True))
    safety.stop(SafetyMode.ROBOT_EMERGENCY_STOP)
    assert safety.demand is Demand.PAUSE
    passing(safety, 0.1)
    assert safety.demand is Demand.PAUSE


_EVENTS = st.one_of(
    st.tuples(st.just("stop"), st.sampled_from([3, 4, 5, 6, 7, 8, 9, 13, 21])),
    st.tuples(st.just("release"), st.sampled_from([3, 4, 5, 6, 7, 13, 21])),
    st.tuples(st.sampled_from(["power_on", "power_off", "release_brakes", "unlock_protective_stop", "restart"])),
    st.tuples(st.just("reduce"), st.booleans()),
    st.tuples(st.just("pass"), st.floats(0.0, 3.0), st.booleans()),
)


@settings(max_examples=scaled(2000))
@given(st.lists(_EVENTS, max_size=25))
def test_modes_and_bits_always_agree(events):
    safety = Safety(Assumptions())
    for name, *values in events:
        if name == "pass":
            passing(safety, values[0], at_rest=values[1])
        else:
            try:
                getattr(safety, name)(*values)
            except OperationRefusedError:
                continue
        mode, bits = safety.safety_mode, safety.safety_bits
        stopped = mode not in (SafetyMode.NORMAL, SafetyMode.REDUCED)
        assert bool(bits & SafetyBits.STOPPED_DUE_TO_SAFETY) == stopped
        assert bool(bits & SafetyBits.NORMAL) == (mode == SafetyMode.NORMAL)
        assert bool(bits & SafetyBits.PROTECTIVE_STOPPED) >= (mode == SafetyMode.PROTECTIVE_STOP)
        assert bool(bits & SafetyBits.VIOLATION) >= (mode == SafetyMode.VIOLATION)
        assert safety.may_move == (not stopped and safety.robot_mode == RobotMode.RUNNING)
        assert safety.may_move == (safety.demand is Demand.NONE)
        if bits & (SafetyBits.EMERGENCY_STOPPED | SafetyBits.VIOLATION | SafetyBits.FAULT):
            safety.tick(TICK_S, at_rest=True)
            assert safety.robot_mode == RobotMode.POWER_OFF


def test_brakes_stay_closed_during_an_emergency_stop():
    safety = Safety(Assumptions())
    safety.stop(SafetyMode.ROBOT_EMERGENCY_STOP)
    safety.release(SafetyMode.ROBOT_EMERGENCY_STOP)
    passing(safety, 0.05, at_rest=False)
    with pytest.raises(OperationRefusedError, match="while it stops after an emergency stop"):
        safety.release_brakes()
    passing(safety, 0.05)
    assert safety.robot_mode == RobotMode.POWER_OFF
    safety.release_brakes()
    passing(safety, 2.0)
    assert safety.may_move
