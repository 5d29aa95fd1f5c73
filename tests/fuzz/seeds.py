"""Valid input of every target, as real peers and files have it: all of it is accepted."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import asdict
from typing import Final

import numpy as np
from safetensors.numpy import save

from dual_ur10.policies.learned.checkpoint import _tensors
from dual_ur10.policies.remote.wire import packed
from dual_ur10.sim2real.calibration import data_file
from dual_ur10.sim2real.cell_file.reference import EXAMPLES, starting_text
from dual_ur10.sim2real.recording import mcap_records as mcap
from dual_ur10.sim2real.recording.encoding import single_record
from dual_ur10.sim2real.recording.rows import BeginRow, StepRow
from dual_ur10.sim2real.recording.run import RunEvent
from dual_ur10.sim2real.recording.schemas import EPISODE_TOPIC, EVENT, EVENT_TOPIC, STEP_TOPIC, TOPICS
from dual_ur10.sim2real.trajectory.files import _csv_of, _json_of
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
from tests.fuzz.targets import HEADER, MANIFEST, NETWORKS, PREAMBLE, PROFILE, in_pieces
from tests.policies.learned.acts import act_parts
from tests.ur_emulator.rtde_bytes import VERSION_2, data, inputs, message, outputs
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.protocol.primary_messages import version_message
from ur_core.protocol.primary_packet import PrimaryPacket
from ur_emulator.controller.rtde_variables import zero_values

_SAMPLE: Final = "d6diI"
_STREAM: Final = [
    message("S", b"\1"),
    data(1, _SAMPLE, 1.0, *range(6), 7, 1),
    message("M", b"\2hi\1x\3"),
    data(1, _SAMPLE, 1.008, *range(6), 7, 1),
]
_TYPES: Final = b"\1DOUBLE,VECTOR6D,INT32,DOUBLE"
_INPUTS: Final = ["input_int_register_0", "input_double_register_0", "input_bit_registers0_to_31"]

_PROGRAM: Final = b"""\
def p():
  global q = [0.1, -1.5, 1.5, -1.5, -1.5, 0]
  thread t():
    while True:
      enter_critical
      q[0] = q[0] + 0.001
      exit_critical
      sync()
    end
  end
  def f(a, b=2):
    if a > b and not (a == 3): # a comment
      return f(a - 1, b=b)
    elif a < 0:
      return p[a, 0, 0, 0, 0, 0]
    else:
      return norm([a, b]) % 2
    end
  end
  h = run t()
  i = 0
  while i < 3:
    i = i + 1
    x = to_str(f(i)) == "1" xor False
    sleep(0.008)
  end
  m = [[1, 2], [3, 4]]
  m[0, 1] = length(str_cat("a", "b"))
  y = pose_trans(p[0, 0, 0, 0, 0, 1], pose_inv(p[1, 0, 0, 0, 0, 0]))
  kill h
  join h
end
"""

_MOVES: Final = b"""\
def m():
  set_tcp(p[0, 0, 0.1, 0, 0, 0])
  textmsg("at ", get_actual_joint_positions())
  servoj([0.01, -1.57, 1.57, -1.57, -1.57, 0], t=0.008, lookahead_time=0.1, gain=300)
  servoj([0.02, -1.57, 1.57, -1.57, -1.57, 0], t=0.008, lookahead_time=0.1, gain=300)
  stopj(2)
  write_output_integer_register(0, read_input_integer_register(0) + 1)
  rtde_set_watchdog("input_int_register_0", 10, "stop")
  movej([0.2, -1.57, 1.57, -1.57, -1.57, 0], a=1.2, v=0.5)
  movel(get_forward_kin(), a=0.5, v=0.1)
  popup("done", "title")
end
sec s():
  set_digital_out(1, True)
end
"""

_INJECTED: Final = [
    {"do": "info"},
    {"do": "state", "arm": "left", "names": ["actual_q", "timestamp"]},
    {"do": "pose", "body": "block", "noise_m": 0.001, "noise_rad": 0.01, "delay_s": 0.1},
    {"do": "place", "position_m": [0.1, 0.0, 0.2], "quat": [1.0, 0.0, 0.0, 0.0]},
    {"do": "push", "arm": "right", "wrench": [0.0, 12.0, 0.0, 0.0, 0.0, 0.5], "seconds": 0.5},
    {"do": "setpoints", "arm": "right", "since": 0},
    {"do": "received", "arm": "left", "since": -3},
    {"do": "clients", "arm": "left"},
    {"do": "stop", "arm": "left", "mode": 3, "reason": "a test"},
    {"do": "release", "arm": "left", "mode": 3},
    {"do": "reduce", "arm": "left", "on": True},
    {"do": "press", "arm": "left", "button": "power_off"},
    {"do": "slider", "arm": "left", "fraction": 0.5},
    {"do": "remote", "arm": "left", "on": False},
    {"do": "input", "arm": "left", "bit": 3, "on": True},
    {"do": "program", "arm": "left", "name": "a.urp", "text": "def p():\n sync()\nend\n"},
    {"do": "link", "arm": "left", "port": "rtde", "jitter_s": 0.01, "lose": 2},
    {"do": "heal", "arm": "left", "port": "all"},
    {"do": "drop", "arm": "left", "port": "rtde", "reset": True, "writers": True},
    {"do": "refuse", "arm": "left", "port": "dashboard"},
    {"do": "override", "arm": "left", "robot_mode": 5, "actual_q": [0, 0, 0, 0, 0, 0.5], "timestamp": None},
    {"do": "watchdog", "arm": "left", "on": False},
    {"do": "script_delay", "arm": "left", "seconds": 0.5},
    {"do": "pretend", "arm": "left", "version": [5, 9, 0, 1], "model": "UR5", "robot_type": 1, "safety_checksum": 7},
    {"do": "calibration", "arm": "left", "error_m": 0.001},
    {"do": "shutdown"},
]

_BEGIN: Final = BeginRow(
    seed=1, q_rad=np.zeros(12), flange_m=np.zeros(6), observation=np.zeros(2), initial_state=b"state"
).encode(0, 0.0)


def _step(number: int) -> bytes:
    return StepRow(
        action=np.zeros(2),
        targets_rad=np.zeros(12),
        gripper_m=np.zeros(2),
        gated=False,
        reward=1.0,
        terminated=False,
        truncated=number == 1,
        success=True,
        ended_by="end",
        time_s=0.04 * (number + 1),
        q_rad=np.zeros(12),
        flange_m=np.zeros(6),
        observation=np.zeros(2),
        first_target=number,
    ).encode(0, number)


_EVENT: Final = EVENT.encode(vars(RunEvent(0.1, "stop", "a text", "left")))
_SINGLE: Final = {EPISODE_TOPIC: [_BEGIN], STEP_TOPIC: [_step(0), _step(1)], EVENT_TOPIC: [_EVENT]}
_MESSAGES: Final = [(topic, each) for topic, messages in _SINGLE.items() for each in messages]


def _file() -> bytes:
    records = [
        single_record(TOPICS.index(topic) + 1, count, 0, each)
        for topic, messages in _SINGLE.items()
        for count, each in enumerate(messages)
    ]
    body = PREAMBLE + mcap.chunk(0, 0, b"".join(records))
    end = mcap.data_end(zlib.crc32(body))
    return body + end + mcap.ending(len(body) + len(end), [])


_PRIMARY: Final = version_message(PROFILE) + PrimaryPacket(PROFILE, NOMINAL_DH).state(zero_values(PROFILE))
_MANIFEST: Final = json.loads(MANIFEST.text())
_ACT: Final = act_parts("DualUR10/SineTracking-v0")[1].text().encode()
_FLAT: Final = struct.pack("<d", 0.5)

_TRAJECTORY: Final = JointTrajectory(("left", "right"), [0.0, 1.5], *np.zeros((3, 2, 2, 6)))
_Q: Final = (0.1, -1.2, 1.6, -2.0, -1.6, 0.0)
_TIP: Final = (0.0, 0.0, 0.17)
_CALIBRATION: Final = data_file.DataFile(
    noise=data_file.NoiseEntry(touch_m=2e-4),
    board=data_file.BoardEntry(squares_x=7, squares_y=5, square_m=0.04, marker_m=0.03),
    cameras={"left": data_file.CameraEntry(matrix_px=(900.0, 900.0, 640.0, 360.0), distortion=(0.1, 0.0))},
    observations=(
        data_file.TouchEntry(left_q_rad=_Q, right_q_rad=_Q, left_tcp_m=_TIP, right_tcp_m=_TIP, time="2026-01-31"),
        data_file.BarEntry(left_q_rad=_Q, right_q_rad=_Q, grasp="2"),
        data_file.ViewEntry(
            camera_on="left", board_on="fixed", left_q_rad=_Q, position_m=(0.1, 0.0, 0.6), rotation_rad=(0.0, 3.0, 0.0)
        ),
    ),
)

SEEDS: Final[dict[str, list[bytes]]] = {
    "rtde_frames": [in_pieces(*_STREAM), in_pieces(b"\0\3S\0\4U", b"\1\0\3P")],
    "rtde_stream": [in_pieces(*_STREAM), in_pieces(b"".join(_STREAM)[:50], b"".join(_STREAM)[50:])],
    "rtde_client": [
        in_pieces(
            message("V", b"\1"),
            message("v", struct.pack(">4I", 5, 12, 5, 1101)),
            message("O", _TYPES),
            message("S", b"\1"),
            data(1, "d6did", 1.0, *range(6), 7, 2.5),
        ),
        in_pieces(
            message("V", b"\1"),
            message("v", struct.pack(">4I", 3, 15, 8, 1)),
            message("O", b"\0DOUBLE,VECTOR6D,INT32,NOT_FOUND"),
            message("O", b"\1DOUBLE,VECTOR6D,INT32"),
            message("S", b"\1"),
        ),
    ],
    "rtde_server": [
        in_pieces(
            *(VERSION_2, message("v"), outputs(["timestamp", "actual_q"], 125.0), inputs(_INPUTS), message("S")),
            *(data(1, "idI", 1, 0.5, 7), data(1, "id", 1, 0.5), message("M", b"\2hi\1x\3"), message("P")),
        ),
        in_pieces(outputs(["timestamp"])[:3] + b"timestamp", inputs(["external_force_torque", "x"]), message("S")),
    ],
    "primary_client": [in_pieces(_PRIMARY)],
    "primary_messages": [b"C153A0\nposition deviates", b"C50\n\xff"],
    "text_lines": [in_pieces(b"one\r\ntw", b"o\n\n\xff\n")],
    "dashboard_server": [
        b"\xff" + in_pieces(b"power on\nbrake release\n", b"robotmode\nload a.urp\nplay\npopup hello\nsafetystatus\n"),
        b"\0" + in_pieces(b"setUserRole operator\ngetuserrole\nunlock protective stop\nquit\n"),
        b"\xff" + in_pieces(b"set operational mode manual\nget operational mode\nis in remote control\nstop\n"),
    ],
    "dashboard_client": [
        in_pieces(
            *(b"Connected: Universal Robots Dashboard Server\n", b"URSoftware 5.12.5.1101 (Nov 20 2023)\n"),
            *(b"Robotmode: RUNNING\n", b"Safetystatus: NORMAL\n", b"STOPPED lift.urp\n", b"true\n"),
            *(b"2021500001\n", b"UR10\n", b"Stopped\n"),
        )
    ],
    "gripper_server": [
        in_pieces(b"SET ACT 1\n", b"GET STA\nGET POS\n", *[b"SET GTO 1 POS 255 SPE 255 FOR 100\nGET OBJ\n"] * 9)
    ],
    "gripper_client": [
        in_pieces(b"STA 3\n", b"POS 3\n", b"STA 3\n", b"FLT 0\n", b"OBJ 3\n", b"ack", b"STA 3\n", b"FLT 9\n")
    ],
    "script_splitter": [in_pieces(_PROGRAM[:70], _PROGRAM[70:], b'movej([0])\n$ 1 "x"\n# def\n')],
    "script_program": [_PROGRAM],
    "script_controller": [in_pieces(_MOVES, b"\n", b"movej([0, -1.5, 1.5, -1.5, -1.5, 0])", width=2)],
    "json_client": [
        in_pieces(b'{"ok": true, "value": {"position_m": [0.1, 0.2, 0.3], "quat": [1.0, 0.0, ', b"0.0, 0.0]}}\n")
    ],
    "fault_injection": [in_pieces(json.dumps(each).encode() + b"\n", width=2) for each in _INJECTED],
    "cell_file": [
        starting_text("emulated").encode(),
        starting_text("real", "10.0.0.1", "10.0.0.2", task="DualUR10/SyncCarry-v0").encode(),
        starting_text("emulated").split(EXAMPLES)[0].encode()
        + "\n".join(line.removeprefix("# ") for line in EXAMPLES.splitlines() if "=" in line or "[" in line).encode(),
    ],
    "trajectory_file": [
        b"\0" + _json_of(_TRAJECTORY).encode(),
        b"\1header:\n  frame_id: world\n"
        + b"".join(f"{key}: {json.dumps(each)}\n".encode() for key, each in json.loads(_json_of(_TRAJECTORY)).items()),
        b"\2" + _csv_of(_TRAJECTORY).encode(),
    ],
    "calibration_data": [_CALIBRATION.model_dump_json(exclude_none=True).encode(), b"{}"],
    "checkpoint_manifest": [json.dumps(_MANIFEST).encode(), _ACT],
    "checkpoint_weights": [save(_tensors(NETWORKS, MANIFEST))],
    "record_file": [_file()],
    "record_messages": [
        in_pieces(
            *(bytes([TOPICS.index(topic)]) + each for topic, each in _MESSAGES),
            *(bytes([number]) + _FLAT for number in range(6)),
            width=2,
        )
    ],
    "record_header": [json.dumps(asdict(HEADER)).encode()],
    "record_cdr": [b"\0" + _BEGIN, b"\1" + _step(0), b"\2" + _EVENT],
    "policy_message": [
        packed({"observation": np.linspace(-1.0, 1.0, 6), "time_s": 0.5, "prompt": "carry the bar"}),
        packed({"actions": np.ones((2, 3), dtype=np.float32), "server_timing": {"infer_ms": 1.5}}),
        packed({"dt_s": 0.1, "endpoints": ["infer", "reset"], "camera": np.zeros((1, 2, 3), dtype=np.uint8)}),
    ],
}
