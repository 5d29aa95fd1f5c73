"""Emulated UR controllers, their ports, and the MuJoCo simulation of their arms.

From the lowest layer up: `script` (URScript) and `motion` (reference motion) do not depend on a controller.
`controller` runs one control period with `safety`, `program_runner` and the `builtins`. `arm_server` serves it on UR's
ports through `rtde_session`, `dashboard`, `realtime_packet` and `robotiq`, which use `sockets`. `emulator` advances
both arms together with `cell_world`, and `fault_injection` injects faults. `emulated_cell` starts all of it in a
separate process. `virtual` runs it on a virtual clock, in the process of its user.

Imports of `dual_ur10`: `kinematics`, `assets`, `envs` and `sim2real.{protocol, control, config, links, processes,
runtime}`. There, `cli`, `testing` and the demonstration import it, nothing that moves real arms.
"""
