"""Emulated UR controllers, their ports, and the MuJoCo simulation of their arms.

From the lowest layer up: `script` (URScript) and `motion` (reference motion) do not depend on a controller.
`controller` runs one control period with `safety`, `program_runner` and the `builtins`. `arm_server` serves it on UR's
ports through `rtde_session`, `dashboard`, `realtime_packet` and `robotiq`, which use `sockets`. `emulator` advances
arms together with their `world`: `lone_arm` for a controller by itself, `cell_world` for the two of a cell.
`fault_injection` injects faults. `emulated_cell` starts all of it in a separate process. `virtual` runs it on a virtual
clock, in the process of its user.

Imports of `dual_ur10`: `kinematics`, `assets` and `sim2real.{protocol, processes, control, config, links, runtime}`.
`cell_world` alone imports `envs`, and `emulator` their viewer when it is asked for. In `dual_ur10`, the command
`emulate`, `testing` and the demonstration import this package; nothing that moves real arms does.
"""
