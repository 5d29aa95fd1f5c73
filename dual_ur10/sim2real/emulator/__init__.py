"""Emulated UR controllers: two controllers, their ports, and one MuJoCo simulation of both arms.

From the lowest layer up: `script` (URScript) and `motion` (reference motion) do not depend on a controller.
`controller` runs one control period with `safety`, `program_runner` and the `builtins`. `arm_server` serves it on UR's
ports through `rtde_session`, `dashboard`, `realtime_packet` and `robotiq`, which use `sockets`. `emulator` advances
both arms together with `mujoco_world`, and `fault_injection` injects faults. `emulated_cell` starts all of it in a
separate process.

Imports `sim2real.{protocol, control, config, peripherals}`, `envs` and `kinematics`. The code that moves real arms
never imports it.
"""
