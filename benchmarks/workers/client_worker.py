"""Worker of clients.py: calls of one client library against one controller, one for each line of input.

Run as `client_worker.py LIBRARY HOST` with the Python of a virtual environment that has the libraries. It does not
import this package. Output, one JSON object a line: version of the library and names of the calls; then for each call
what went wrong.
"""

import collections.abc
import importlib.metadata
import json
import math
import sys
import time

STEP_RAD, STEP_M = 0.05, 0.02


def moved(before, after, least):
    """Raise unless something changed."""
    if max(abs(a - b) for a, b in zip(before, after, strict=False)) < least:
        raise RuntimeError("nothing has moved")


def near(found, wanted, within):
    """Raise unless two rows of numbers are equal."""
    off = max(abs(a - b) for a, b in zip(found, wanted, strict=False))
    if not off <= within:
        raise RuntimeError(f"it is {off:.3g} off")


def turned(q, step=STEP_RAD):
    """Return joint angles with the last two turned."""
    return [*q[:4], q[4] + step, q[5] - step]


def shifted(pose, step=STEP_M):
    """Return a pose moved upwards."""
    return [*pose[:2], pose[2] + step, *pose[3:]]


def settled(read, seconds=0.6):
    """Return what is read once the arm has come to rest."""
    time.sleep(seconds)
    return read()


def urx(host):
    """Return the calls of urx, which needs an alias that Python 3.10 has removed."""
    collections.Iterable = collections.abc.Iterable
    import urx as library

    arm = library.Robot(host, use_rt=True)

    def joints():
        return list(arm.getj(wait=True))

    def pose():
        return list(arm.getl(wait=True))

    def movej():
        goal = turned(joints())
        arm.movej(goal, acc=1.0, vel=0.5)
        near(settled(joints), goal, 0.005)

    def linear(name):
        def call():
            goal = shifted(pose())
            getattr(arm, name)(goal, acc=0.5, vel=0.1)
            near(settled(pose)[:3], goal[:3], 0.003)

        return call

    def movec():
        before = pose()
        arm.movec(shifted(before, 0.01), shifted([before[0] + 0.01, *before[1:]], 0.02), acc=0.5, vel=0.05)
        moved(before, settled(pose), 0.005)

    def movels():
        before = pose()
        arm.movels([shifted(before, 0.01), shifted(before, 0.03)], acc=0.5, vel=0.05, radius=0.002)
        moved(before, settled(pose), 0.005)

    def translate():
        before = pose()
        arm.translate((0.0, 0.0, -STEP_M), acc=0.5, vel=0.1)
        moved(before, settled(pose), 0.01)

    def speedj():
        before = joints()
        arm.speedj([0, 0, 0, 0, 0.2, 0], 1.0, 0.5)
        moved(before, settled(joints, 1.0), 0.03)

    def speedl():
        before = pose()
        arm.speedl([0, 0, 0.05, 0, 0, 0], 0.5, 0.5)
        moved(before, settled(pose, 1.0), 0.005)

    def output():
        arm.set_digital_out(2, True)
        time.sleep(0.5)
        if not arm.get_digital_out(2, wait=True):
            raise RuntimeError("the output is not set")

    def realtime():
        monitor = arm.get_realtime_monitor()
        near(list(monitor.q_actual(wait=True)), joints(), 0.01)

    def tcp():
        before = pose()
        arm.set_tcp((0, 0, 0.1, 0, 0, 0))
        moved(before, settled(pose, 1.0), 0.05)
        arm.set_tcp((0, 0, 0, 0, 0, 0))

    def freedrive():
        arm.set_freedrive(True)
        time.sleep(0.5)
        arm.set_freedrive(False)

    calls = {"getj": joints, "getl": pose, "get_pose": arm.get_pose, "get_tcp_force": arm.get_tcp_force, "movej": movej}
    calls |= {name: linear(name) for name in ("movel", "movep", "servoc")}
    calls |= {"movec": movec, "movels": movels, "translate": translate, "speedj": speedj, "speedl": speedl}
    calls |= {"stopj": arm.stopj, "stopl": arm.stopl, "set_tcp": tcp, "set_digital_out": output}
    calls |= {"set_payload": lambda: arm.set_payload(1.0, (0, 0, 0.05)), "get_analog_in": lambda: arm.get_analog_in(0)}
    calls |= {"set_analog_out": lambda: arm.set_analog_out(0, 0.5), "set_tool_voltage": lambda: arm.set_tool_voltage(0)}
    calls |= {
        "get_realtime_monitor": realtime,
        "set_freedrive": freedrive,
        "send_message": lambda: arm.send_message('"x"'),
    }
    calls |= {"set_simulation": lambda: arm.set_simulation(False), "set_gravity": lambda: arm.set_gravity((0, 0, 9.82))}
    return calls


def universal_robots_clients(host):
    """Return the calls of universal-robots-clients."""
    from universal_robots_clients import dashboard_client as dashboard
    from universal_robots_clients import rtde_client as rtde

    arm = rtde.connect(host)
    reads = [name for name in rtde.__all__ if name.startswith(("read_", "is_"))]

    def read(name):
        arguments = {"read_tool": (0,), "read_output": (42,)}
        given = next((value for start, value in arguments.items() if name.startswith(start)), ())
        found = getattr(rtde, name)(*given, client=arm)
        if found is None:
            raise RuntimeError("there is no value")

    def joints():
        if not all(map(math.isfinite, rtde.read_actual_joint_positions(arm))):
            raise RuntimeError("not finite")

    def slider():
        rtde.write_speed_slider_fraction(0.5, client=arm)
        time.sleep(0.5)
        near([rtde.read_speed_slider_fraction(arm)], [0.5], 0.01)
        rtde.write_speed_slider_fraction(1.0, client=arm)

    def tool_output():
        rtde.write_tool_digital_output(0, True, client=arm)
        time.sleep(0.5)
        if not rtde.read_tool_digital_output(0, client=arm):
            raise RuntimeError("the output is not set")

    def ask(command, wanted):
        answer = dashboard.send_command(host, command)
        if wanted.lower() not in answer.lower():
            raise RuntimeError(f"the answer is {answer!r}")

    calls = {"connect": joints, **{name: lambda name=name: read(name) for name in reads}}
    calls |= {"write_speed_slider_fraction": slider, "write_tool_digital_output": tool_output}
    calls |= {"write_input_int_register": lambda: rtde.write_input_int_register(42, 7, client=arm)}
    calls |= {"write_input_double_register": lambda: rtde.write_input_double_register(42, 0.5, client=arm)}
    calls |= {"reconnect": lambda: rtde.reconnect(arm)}
    calls |= {f"dashboard: {name}": lambda name=name, text=text: ask(name, text) for name, text in DASHBOARD.items()}
    calls |= {"get_program_state": lambda: dashboard.get_program_state(host)}
    calls |= {"stop_program": lambda: dashboard.stop_program(host)}
    return calls


DASHBOARD = {"robotmode": "running", "safetystatus": "normal", "PolyscopeVersion": "ursoftware", "running": "program"}


def urkit(host):
    """Return the calls of urkit."""
    from urkit import URRobot

    arm = URRobot(ip=host)

    def relative():
        before = arm.get_joint_positions()
        arm.move_relative(dz=STEP_M)
        moved(before, arm.get_joint_positions(), 0.001)

    def back():
        goal = turned(list(arm.get_joint_positions()))
        arm.rtde_control.moveJ(goal, 0.5, 1.0)
        near(arm.get_joint_positions(), goal, 0.005)

    def solved():
        q = list(arm.get_joint_positions())
        found = arm.inverse_kinematics(list(arm.rtde_receive.getActualTCPPose()), seed=q)
        near(found, q, 0.01)

    def velocity():
        before = list(arm.get_joint_positions())
        arm.move_velocity([0.0, 0.0, 0.03, 0.0, 0.0, 0.0], 0.5)
        arm.speed_stop()
        moved(before, arm.get_joint_positions(), 0.001)

    def output():
        arm.set_digital_output(1, True)
        time.sleep(0.3)
        if not arm.get_digital_output(1):
            raise RuntimeError("the output is not set")

    def slider():
        arm.speed_slider = 0.5
        time.sleep(0.5)
        near([arm.speed_slider], [0.5], 0.02)
        arm.speed_slider = 1.0

    def freedrive():
        arm.enable_freedrive()
        time.sleep(0.3)
        arm.disable_freedrive()

    calls = {
        "URRobot": arm.get_joint_positions,
        "get_tcp_force": arm.get_tcp_force,
        "get_robot_mode": arm.get_robot_mode,
    }
    calls |= {"get_current_point": arm.get_current_point, "move_relative": relative, "moveJ": back}
    calls |= {"inverse_kinematics": solved, "move_velocity, speed_stop": velocity, "set_digital_output": output}
    calls |= {"zero_ft_sensor": arm.zero_ft_sensor, "set_payload": lambda: arm.set_payload(1.0, [0.0, 0.0, 0.05])}
    calls |= {"speed_slider": slider, "enable_freedrive": freedrive, "stop": arm.stop, "power_on": arm.power_on}
    return calls


def ur_rtde(host):
    """Return the calls of ur_rtde."""
    from dashboard_client import DashboardClient
    from rtde_control import RTDEControlInterface
    from rtde_io import RTDEIOInterface
    from rtde_receive import RTDEReceiveInterface

    see, do, io, dashboard = (
        RTDEReceiveInterface(host),
        RTDEControlInterface(host),
        RTDEIOInterface(host),
        DashboardClient(host),
    )
    dashboard.connect()

    def done(answer):
        if answer is False:
            raise RuntimeError("it returned False")

    def joint(name, *more):
        def call():
            goal = turned(see.getActualQ())
            done(getattr(do, name)(goal, *more))
            near(settled(see.getActualQ), goal, 0.005)

        return call

    def linear(name, *more):
        def call():
            goal = shifted(see.getActualTCPPose())
            done(getattr(do, name)(goal, *more))
            near(settled(see.getActualTCPPose)[:3], goal[:3], 0.003)

        return call

    def speed(name, rate, stop):
        def call():
            before = see.getActualQ()
            done(getattr(do, name)(rate, 0.5, 0.3))
            time.sleep(0.5)
            done(getattr(do, stop)())
            moved(before, see.getActualQ(), 0.002)

        return call

    def servo():
        q, before = see.getActualQ(), see.getActualQ()
        for _ in range(100):
            q[5] += 0.001
            done(do.servoJ(q, 0.0, 0.0, 0.008, 0.05, 500))
            time.sleep(0.008)
        done(do.servoStop())
        moved(before, see.getActualQ(), 0.03)

    def force():
        for _ in range(20):
            done(do.forceMode([0.0] * 6, [0, 0, 1, 0, 0, 0], [0.0] * 6, 2, [0.05, 0.05, 0.05, 0.2, 0.2, 0.2]))
            time.sleep(0.008)
        done(do.forceModeStop())

    def kinematics():
        q = see.getActualQ()
        near(do.getInverseKinematics(see.getActualTCPPose(), q), q, 1e-3)
        near(do.getForwardKinematics()[:3], see.getActualTCPPose()[:3], 5e-3)

    def output():
        done(io.setStandardDigitalOut(3, True))
        time.sleep(0.3)
        done(see.getDigitalOutState(3))

    def freedrive():
        done(do.freedriveMode())
        time.sleep(0.2)
        done(do.endFreedriveMode())

    calls = {"getActualQ": see.getActualQ, "getActualTCPPose": see.getActualTCPPose, "robotmode": dashboard.robotmode}
    calls |= {
        "moveJ": joint("moveJ", 0.5, 1.0),
        "moveL": linear("moveL", 0.1, 0.5),
        "servoJ": servo,
        "forceMode": force,
    }
    calls |= {"speedJ": speed("speedJ", [0, 0, 0, 0, 0.1, 0], "speedStop")}
    calls |= {"speedL": speed("speedL", [0, 0, 0.03, 0, 0, 0], "speedStop")}
    calls |= {"getForwardKinematics, getInverseKinematics": kinematics, "setStandardDigitalOut": output}
    calls |= {"freedriveMode": freedrive, "zeroFtSensor": lambda: done(do.zeroFtSensor())}
    calls |= {
        "setTcp": lambda: done(do.setTcp([0.0] * 6)),
        "setPayload": lambda: done(do.setPayload(1.0, [0, 0, 0.05])),
    }
    calls |= {"toolContact": lambda: do.toolContact([0, 0, 1, 0, 0, 0]), "getStepTime": do.getStepTime}
    calls |= {"isSteady": do.isSteady, "stopScript": do.stopScript, "reuploadScript": lambda: done(do.reuploadScript())}
    return calls


LIBRARIES = {"urx": urx, "universal-robots-clients": universal_robots_clients, "urkit": urkit, "ur-rtde": ur_rtde}


def main() -> None:
    """Make a call for each line of input, until it ends."""
    name, host = sys.argv[1:]
    answers = sys.stdout
    sys.stdout = sys.stderr  # of what the libraries print
    try:
        calls, error = LIBRARIES[name](host), ""
    except Exception as found:  # of any kind: it is the result
        calls, error = {}, f"{type(found).__name__}: {found}"
    print(json.dumps({"version": importlib.metadata.version(name), "error": error, "calls": list(calls)}), file=answers)
    answers.flush()
    for line in sys.stdin:
        try:
            calls[line.strip()]()
            error = ""
        except Exception as found:
            error = f"{type(found).__name__}: {found}"
        print(json.dumps({"error": error}), file=answers)
        answers.flush()


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    sys.stderr.flush()
    import os

    os._exit(0)  # threads of the libraries may wait for ever
