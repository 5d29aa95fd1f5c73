"""Virtual cells: program, processes of the runner and emulated controllers in one process, on one virtual clock.

`scheduler` switches between actors and owns the time, `network` joins transports in memory, and `virtual_system` gives
both to every process as its operating system. `control` commands a controller as `ur_rtde` does, and `virtual_cell`
puts all together.

The room is part of the emulator, because a virtual cell is two emulated controllers on another clock: nothing in
`dual_ur10` imports it but `testing`. The runner is not imported here either. It runs on the virtual clock because it
takes time and connections from its `System`.
"""
