"""Emulated UR controllers: two controllers, their ports, and one MuJoCo simulation of both arms.

Bottom up: `script` (URScript) and `motion` (reference motion) know no controller. `controller` runs one control period
with `safety`, `program_runner` and the `builtins` handed to it. `arm_server` serves it on UR's ports: `rtde_session`,
`dashboard`, `realtime_packet` and `robotiq`, on `sockets`. `emulator` ticks both arms together with `mujoco_world`, and
`fault_injection` disturbs them. `emulated_cell` starts all this in a process of its own.

Imports `sim2real.{protocol, control, config, peripherals}`, `envs` and `kinematics`. Nothing that moves real arms
imports it.
"""
