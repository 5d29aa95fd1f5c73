"""Virtual cells: program, processes of the runner and emulated controllers in one process, on one virtual clock.

`scheduler` switches between actors and owns the time, `network` joins transports in memory, and `virtual_system` gives
both to every process as its operating system. `control` commands a controller as `ur_rtde` does, and `virtual_cell`
puts all together. Imports all rooms of `sim2real` but `analysis`. Imported by `testing`.
"""
