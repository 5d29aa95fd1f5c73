"""Runs of the unmodified `ur_rtde` client, each in a process of its own.

A client that does not receive an expected answer may wait forever, or end its process. The functions take a host and
plain values, and return plain values. They do not depend on whether the controller is emulated.
"""

import importlib
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]


class ClientFailed(AssertionError):
    """The client's process failed or did not end."""


def run(function, *args, timeout=60.0, module=None):
    """Run a function of this or another module in a process of its own, and return its result."""
    process = subprocess.run(
        [
            sys.executable,
            "-m",
            "tests.ur_emulator.clients",
            module or __name__,
            function.__name__,
            json.dumps(args),
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    lines = process.stdout.strip().splitlines()
    if process.returncode or not lines or not lines[-1].startswith("RESULT "):
        raise ClientFailed(f"{function.__name__}: code {process.returncode}\n{process.stdout}\n{process.stderr}")
    return json.loads(lines[-1].removeprefix("RESULT "))


def _interfaces(host, *, io=False):
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive = RTDEReceiveInterface(host)
    control = RTDEControlInterface(host)
    if not io:
        return control, receive
    from rtde_io import RTDEIOInterface

    return control, receive, RTDEIOInterface(host)


def _shifted(values, shifts):
    return [value + shift for value, shift in zip(values, shifts, strict=True)]


def _for(control, seconds, call, *args):
    """Call repeatedly, once per control period."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        start = control.initPeriod()
        call(*args)
        control.waitPeriod(start)


def _settled(read):
    """Return a reading once the receiving connection has caught up with the commanding one."""
    time.sleep(0.25)
    return read()


def _error(call, *args):
    """Return name and text of the exception that a call raises, or None."""
    try:
        call(*args)
    except Exception as error:
        return [type(error).__name__, str(error)]
    return None


def moves(host):
    """Run every blocking and asynchronous move and stop. Return the targets and the final positions."""
    control, receive = _interfaces(host)
    home = receive.getActualQ()
    done = {"home": home}
    there = _shifted(home, [0.2, -0.1, 0.1, 0.05, -0.1, 0.3])
    done["moveJ"] = [control.moveJ(there, 1.0, 2.0), there, _settled(receive.getActualQ)]
    pose = receive.getActualTCPPose()
    pose[2] += 0.05
    done["moveL"] = [control.moveL(pose, 0.2, 1.0), pose, _settled(receive.getActualTCPPose)]
    pose = _shifted(pose, [0.0, 0.04, 0.0, 0.0, 0.0, 0.0])
    done["moveJ_IK"] = [control.moveJ_IK(pose, 1.0, 2.0), pose, _settled(receive.getActualTCPPose)]
    done["moveL_FK"] = [control.moveL_FK(there, 0.3, 1.0), there, _settled(receive.getActualQ)]
    time.sleep(0.6)
    done["isSteady"] = control.isSteady()

    control.moveJ(home, 0.3, 0.5, True)
    time.sleep(0.3)
    done["steady while moving"] = control.isSteady()
    done["running while moving"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    begin = receive.getActualQ()
    control.stopJ(2.0)
    time.sleep(0.25)
    rest = receive.getActualQ()
    time.sleep(0.25)
    done["stopJ"] = [begin, rest, receive.getActualQ(), receive.getActualQd()]
    pose = receive.getActualTCPPose()
    goal = list(pose)
    goal[2] += 0.2
    control.moveL(goal, 0.2, 0.5, True)
    time.sleep(0.4)
    control.stopL(2.0)
    time.sleep(0.25)
    rest = receive.getActualTCPPose()
    time.sleep(0.25)
    done["stopL"] = [pose, goal, rest, receive.getActualTCPPose()]
    done["back"] = [control.moveJ(home, 1.0, 2.0), home, _settled(receive.getActualQ)]
    control.stopScript()
    return done


def _seen(receive):
    """Return time and q of one package, or None if the two values are of different packages."""
    before, q = receive.getTimestamp(), receive.getActualQ()
    return [before, q] if receive.getTimestamp() == before else None


def servo(host, count, period_s):
    """Stream servoJ with a distinct time per call, and stop. Return the targets, and one q after each."""
    control, receive = _interfaces(host)
    home = receive.getActualQ()
    targets, late = [], 0
    due = time.monotonic()
    for k in range(count):
        t = k * period_s
        swing = 0.1 * (1 - math.cos(2 * math.pi * t / 2.0)) / 2
        targets.append(_shifted(home, [swing, -swing, swing, 0.0, swing, k * 1e-6]))
        control.servoJ(targets[-1], 0.0, 0.0, period_s, 0.05, 800)
        due += period_s
        left = due - time.monotonic()
        late += left < 0
        time.sleep(max(0.0, left))
    time.sleep(0.05)
    seen = None
    for _ in range(1000):  # usually at once, unless a package arrives in between
        seen = seen or _seen(receive)
    time.sleep(0.5)
    end = receive.getActualQ()
    control.servoStop()
    control.stopScript()
    return {"home": home, "targets": targets, "seen": seen, "end": end, "late": late}


def servo_both(hosts, count, period_s):
    """Stream servoJ to two arms from one process. Return per arm the targets, and measurements with their times."""
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive = [RTDEReceiveInterface(host) for host in hosts]
    control = [RTDEControlInterface(host) for host in hosts]
    home = [each.getActualQ() for each in receive]
    sent, seen, late = [[], []], [[], []], 0
    due = time.monotonic()
    for k in range(count):
        swing = 0.15 * (1 - math.cos(2 * math.pi * k * period_s / 2.0)) / 2
        for arm in range(2):
            sent[arm].append(_shifted(home[arm], [swing, -swing, swing, swing, -swing, k * 1e-7]))
            control[arm].servoJ(sent[arm][-1], 0.0, 0.0, period_s, 0.05, 800)
            seen[arm] += [each for each in [_seen(receive[arm])] if each]
        due += period_s
        left = due - time.monotonic()
        late += left < 0
        time.sleep(max(0.0, left))
    for each in control:
        each.servoStop()
        each.stopScript()
    return {"home": home, "sent": sent, "seen": seen, "late": late}


def streams(host):
    """Run speeds, servoing in space and jogging, and return the motion of the arm."""
    control, receive = _interfaces(host)
    home = receive.getActualQ()
    done = {}

    begin = receive.getActualQ()
    _for(control, 0.5, control.speedJ, [0.1, 0.0, 0.0, 0.0, 0.0, -0.2], 2.0, 0.05)
    done["speedJ while"] = receive.getActualQd()
    control.speedStop(5.0)
    time.sleep(0.25)
    done["speedJ"] = [begin, receive.getActualQ(), receive.getActualQd()]
    control.moveJ(home, 1.0, 2.0)

    pose = receive.getActualTCPPose()
    _for(control, 0.6, control.speedL, [0.0, 0.0, 0.05, 0.0, 0.0, 0.0], 0.5, 0.05)
    done["speedL while"] = receive.getActualTCPSpeed()
    control.speedStop(5.0)
    time.sleep(0.25)
    done["speedL"] = [pose, receive.getActualTCPPose(), receive.getActualQd()]

    pose = receive.getActualTCPPose()
    goal = list(pose)
    for _ in range(60):
        goal[2] -= 0.0004
        start = control.initPeriod()
        control.servoL(goal, 0.0, 0.0, 0.008, 0.05, 800)
        control.waitPeriod(start)
    time.sleep(0.4)
    done["servoL"] = [goal, receive.getActualTCPPose()]
    control.servoStop()

    pose = receive.getActualTCPPose()
    control.jogStart([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
    time.sleep(1.0)
    control.jogStop()
    time.sleep(0.2)
    done["jog"] = [pose, receive.getActualTCPPose(), receive.getActualQd()]

    pose = receive.getActualTCPPose()
    goal = _shifted(pose, [0.0, 0.0, 0.03, 0.0, 0.0, 0.0])
    done["servoC"] = control.servoC(goal, 0.1, 0.5, 0.0)
    time.sleep(1.0)
    done["servoC moved"] = [goal, receive.getActualTCPPose()]
    # The client takes servoC for a command that is not waited for, the script does not: the next one fails, in 4 s.
    done["after servoC"] = control.servoC(goal, 0.1, 0.5, 0.0)
    control.servoStop()
    done["back"] = control.moveJ(home, 1.0, 2.0)
    control.stopScript()
    return done


def queries(host):
    """Query all values that a controller computes and reports."""
    control, receive = _interfaces(host)
    done = {}
    q, pose = receive.getActualQ(), receive.getActualTCPPose()
    done["q"], done["pose"] = q, pose
    done["default pose"] = control.getForwardKinematics()
    control.setTcp([0.01, 0.02, 0.15, 0.1, 0.0, 0.0])
    done["tcp"] = control.getTCPOffset()
    time.sleep(0.25)
    done["pose at tcp"] = receive.getActualTCPPose()
    done["flange"] = [control.getActualToolFlangePose(), time.sleep(0.05), control.getActualToolFlangePose()][2]
    done["forward"] = control.getForwardKinematics(q, [0.01, 0.02, 0.15, 0.1, 0.0, 0.0])
    done["inverse"] = control.getInverseKinematics(done["pose at tcp"], q)
    control.setTcp([0.0] * 6)
    done["inverse default"] = control.getInverseKinematics(pose)
    far = [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    done["has solution"] = [control.getInverseKinematicsHasSolution(each) for each in (pose, far)]
    done["pose safe"] = [control.isPoseWithinSafetyLimits(each) for each in (pose, far)]
    done["joints safe"] = [control.isJointsWithinSafetyLimits(each) for each in (q, [7.0, *q[1:]])]
    done["poseTrans"] = control.poseTrans([0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    done["payload"] = [control.setPayload(1.5, [0.0, 0.01, 0.05]), time.sleep(0.05), receive.getPayload()][::2]
    done["target payload"] = control.setTargetPayload(1.0, [0.0, 0.0, 0.05], [0.01, 0.01, 0.01, 0.0, 0.0, 0.0])
    time.sleep(0.05)
    done["target payload is"] = [receive.getPayload(), receive.getPayloadCog(), receive.getPayloadInertia()]
    control.setPayload(0.0, [0.0, 0.0, 0.001])
    control.getStepTime()
    time.sleep(0.05)
    done["step time"] = control.getStepTime()
    control.getJointTorques()
    time.sleep(0.05)
    done["torques"] = control.getJointTorques()
    control.getActualJointPositionsHistory(3)
    time.sleep(0.05)
    done["history"] = control.getActualJointPositionsHistory(3)
    done["waypoint"] = control.getTargetWaypoint()
    done["gravity"] = control.setGravity([0.0, 0.0, 9.82])
    done["steady"] = control.isSteady()
    done["zero ft"] = control.zeroFtSensor()
    done["external ft"] = [control.ftRtdeInputEnable(True, 0.0), control.enableExternalFtSensor(False, 0.0)]
    done["damping"] = [control.forceModeSetDamping(0.05), control.forceModeSetGainScaling(0.5)]
    done["timestamp"] = receive.getTimestamp()
    done["modes"] = [receive.getRobotMode(), receive.getSafetyMode(), receive.getRuntimeState()]
    done["bits"] = [receive.getRobotStatus(), receive.getSafetyStatusBits()]
    done["speeds"] = [receive.getSpeedScaling(), receive.getTargetSpeedFraction()]
    done["force"] = receive.getActualTCPForce()
    done["temperatures"] = receive.getJointTemperatures()
    done["running"] = control.isProgramRunning()
    control.stopScript()
    time.sleep(0.25)
    done["running after stop"] = control.isProgramRunning()
    done["after stop"] = control.moveJ(q)
    done["uploaded again"] = control.reuploadScript()
    time.sleep(0.2)
    done["and moved"] = control.moveJ(q)
    control.stopScript()
    return done


def compliance(host):
    """Run force mode, freedrive and contact detection: the arm moves, and stands again."""
    control, receive = _interfaces(host)
    home = receive.getActualQ()
    done = {}
    begin = receive.getActualTCPPose()
    wrench = [0.0, 0.0, 10.0, 0.0, 0.0, 0.0]
    _for(control, 0.8, control.forceMode, [0.0] * 6, [0, 0, 1, 0, 0, 0], wrench, 2, [2, 2, 0.5, 1, 1, 1])
    control.forceModeStop()
    time.sleep(0.25)
    done["forceMode"] = [begin, receive.getActualTCPPose(), receive.getActualQd()]
    done["teach"] = [control.teachMode(), control.endTeachMode()]
    done["freedrive"] = [control.freedriveMode(), control.getFreedriveStatus(), control.endFreedriveMode()]
    done["after"] = receive.getActualTCPPose()
    done["contact"] = [control.startContactDetection(), control.readContactDetection(), control.stopContactDetection()]
    done["toolContact"] = control.toolContact([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    done["back"] = control.moveJ(home, 1.0, 2.0)
    control.stopScript()
    return done


def paths(host):
    """Move through several points with progress, and run an own program."""
    from rtde_control import Path as UrPath
    from rtde_control import PathEntry

    control, receive = _interfaces(host)
    home = receive.getActualQ()
    done = {}
    points = [_shifted(home, [0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.0]) for k in (1, 2, 1)]
    done["moveJ path"] = [control.moveJ([[*q, 1.0, 2.0, r] for q, r in zip(points, (0.0, 0.02, 0.0), strict=True)])]
    done["moveJ path"] += [points[-1], _settled(receive.getActualQ)]
    pose = receive.getActualTCPPose()
    corners = [_shifted(pose, [0.0, 0.0, 0.05 * k, 0.0, 0.0, 0.0]) for k in (1, 2)]
    done["moveL path"] = [control.moveL([[*each, 0.2, 1.0, r] for each, r in zip(corners, (0.01, 0.0), strict=True)])]
    done["moveL path"] += [corners[-1], _settled(receive.getActualTCPPose)]

    path = UrPath()
    for q in (home, points[0], home):
        path.addEntry(PathEntry(PathEntry.MoveJ, PathEntry.PositionJoints, [*q, 0.5, 2.0, 0.0]))
    done["started"] = control.movePath(path, True)
    seen = []
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        progress = control.getAsyncOperationProgressEx()
        word = [progress.isAsyncOperationRunning(), progress.progress() if progress.isAsyncOperationRunning() else -1]
        if not seen or seen[-1] != word:
            seen.append(word)
        if len(seen) > 1 and not word[0]:
            break
        time.sleep(0.002)
    done["progress"] = seen
    done["movePath"] = [home, _settled(receive.getActualQ)]
    done["custom"] = control.sendCustomScriptFunction("own", "set_standard_digital_out(3, True)\nsleep(0.1)\n")
    time.sleep(0.25)
    done["custom did"] = receive.getDigitalOutState(3)
    control.stopScript()
    return done


def inputs_outputs(host):
    """Set outputs, the slider, and registers."""
    control, receive, io = _interfaces(host, io=True)
    done = {"set": [], "cleared": []}
    for value, key in ((True, "set"), (False, "cleared")):
        for bit in range(8):
            io.setStandardDigitalOut(bit, value)
            io.setConfigurableDigitalOut(bit, value)
        for bit in range(2):
            io.setToolDigitalOut(bit, value)
        time.sleep(0.2)
        done[key] = [receive.getDigitalOutState(bit) for bit in range(18)]
    io.setAnalogOutputVoltage(0, 0.5)
    io.setAnalogOutputCurrent(1, 0.25)
    time.sleep(0.25)
    done["analog"] = [receive.getStandardAnalogOutput0(), receive.getStandardAnalogOutput1()]
    io.setSpeedSlider(0.3)
    time.sleep(0.6)
    done["slider"] = [receive.getTargetSpeedFraction(), receive.getSpeedScaling()]
    io.setSpeedSlider(1.0)
    done["registers"] = [io.setInputIntRegister(18, 7), io.setInputDoubleRegister(19, 2.5)]
    done["bad register"] = [_error(io.setInputIntRegister, 3, 7), _error(io.setInputDoubleRegister, 25, 1.0)]
    echo = "write_output_integer_register(14, read_input_integer_register(18))\n"
    echo += "write_output_float_register(15, read_input_float_register(19))\n"
    control.sendCustomScriptFunction("echo", echo)
    time.sleep(0.25)
    done["echo"] = [receive.getOutputIntRegister(14), receive.getOutputDoubleRegister(15)]
    control.stopScript()
    return done


def arguments(host):
    """Pass arguments that `ur_rtde` refuses, and some that it does not check."""
    control, receive = _interfaces(host)
    q = receive.getActualQ()
    done = {
        "speed": _error(control.moveJ, q, 4.0),
        "lookahead": _error(control.servoJ, q, 0, 0, 0.008, 0.01, 300),
        "gain": _error(control.servoJ, q, 0, 0, 0.008, 0.1, 50),
    }
    # Its own check lets these through: they are for the controller to refuse.
    done["nan"] = control.moveJ([math.nan] * 6)
    time.sleep(0.2)
    done["running"] = control.isProgramRunning()
    done["q"] = receive.getActualQ()
    done["begin"] = q
    return done


def watchdog(host):
    """Set a watchdog, then stop feeding it."""
    control, receive = _interfaces(host)
    done = {"set": control.setWatchdog(1.0)}
    for _ in range(20):
        control.kickWatchdog()
        time.sleep(0.04)
    done["kept"] = control.isProgramRunning()
    begin = time.monotonic()
    while control.isProgramRunning() and time.monotonic() < begin + 20.0:
        time.sleep(0.001)
    done["stopped after"] = time.monotonic() - begin
    done["next"] = control.moveJ(receive.getActualQ())
    return done


def dashboard(host):
    """Call every method of the dashboard client that does not end the controller."""
    from dashboard_client import DashboardClient

    client = DashboardClient(host)
    client.connect()
    done = {}
    names = (
        "robotmode", "safetymode", "safetystatus", "programState", "polyscopeVersion", "getLoadedProgram", "running",
        "isProgramSaved", "isInRemoteControl", "getRobotModel", "getSerialNumber", "isConnected",
    )  # fmt: skip
    for name in names:
        try:
            done[name] = getattr(client, name)()
        except Exception as error:
            done[name] = [type(error).__name__, str(error)]
    for name, args in (
        ("popup", ["hello"]), ("closePopup", []), ("closeSafetyPopup", []), ("addToLog", ["a line"]),
        ("unlockProtectiveStop", []), ("powerOff", []), ("powerOn", []), ("brakeRelease", []),
    ):  # fmt: skip
        done[name] = _error(getattr(client, name), *args)
    done["play"] = _error(client.play)
    done["load"] = _error(client.loadURP, "no_such.urp")
    end = time.monotonic() + 8.0
    while "RUNNING" not in client.robotmode() and time.monotonic() < end:
        time.sleep(0.05)
    done["robotmode at the end"] = client.robotmode()
    client.disconnect()
    return done


def protective_stop(host):
    """Stop protectively, unlock too early and in time, and recover."""
    from dashboard_client import DashboardClient

    control, receive = _interfaces(host)
    client = DashboardClient(host)
    client.connect()
    q = receive.getActualQ()
    done = {"triggered": control.triggerProtectiveStop()}
    begin = time.monotonic()
    while not receive.isProtectiveStopped() and time.monotonic() < begin + 2.0:
        time.sleep(0.001)
    done["stopped"] = [receive.isProtectiveStopped(), receive.getSafetyMode(), client.safetymode()]
    time.sleep(0.3)
    done["state"] = [receive.getRuntimeState(), client.programState()]
    done["servoJ"] = control.servoJ(_shifted(q, [0.1] * 6), 0, 0, 0.008, 0.1, 300)
    done["too early"] = _error(client.unlockProtectiveStop)
    # Five seconds of the controller's time, which on a busy machine are more of ours.
    end = time.monotonic() + 30.0
    time.sleep(max(0.0, begin + 5.1 - time.monotonic()))
    while (error := _error(client.unlockProtectiveStop)) and time.monotonic() < end:
        time.sleep(0.2)
    done["unlocked"] = error
    time.sleep(0.2)
    done["after"] = [receive.isProtectiveStopped(), receive.getSafetyMode(), receive.getRuntimeState()]
    done["q"] = [q, receive.getActualQ()]
    done["uploaded"] = control.reuploadScript()
    time.sleep(0.2)
    done["moves"] = control.moveJ(q)
    control.stopScript()
    return done


def constant_changed(host, path):
    """Servo with a modified control script."""
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    flags = RTDEControlInterface.FLAG_CUSTOM_SCRIPT | RTDEControlInterface.FLAG_VERBOSE
    receive = RTDEReceiveInterface(host)
    control = RTDEControlInterface(host, -1.0, flags | RTDEControlInterface.FLAG_NO_WAIT)
    control.setCustomScriptFile(path)
    control.reuploadScript()
    time.sleep(0.5)
    q = receive.getActualQ()
    moved = control.moveJ(_shifted(q, [0.1, 0, 0, 0, 0, 0]), 1.0, 1.0)
    end = _settled(receive.getActualQ)
    control.stopScript()
    return {"begin": q, "end": end, "moved": moved}


def second_control(host):
    """Request the registers of the first client with a second one."""
    from rtde_control import RTDEControlInterface

    first, _ = _interfaces(host)
    error = _error(RTDEControlInterface, host)
    first.stopScript()
    return error


def hold(host, seconds):
    """Connect and stream until killed."""
    control, receive = _interfaces(host)
    q = receive.getActualQ()
    print("READY", flush=True)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        control.servoJ(q, 0, 0, 0.008, 0.1, 300)
        time.sleep(0.008)


if __name__ == "__main__":
    module, name, arguments_given = sys.argv[1:4]
    result = getattr(importlib.import_module(module), name)(*json.loads(arguments_given))
    print("RESULT " + json.dumps(result), flush=True)
    # Skip the destructors of the interfaces, which take half a second each.
    os._exit(0)
