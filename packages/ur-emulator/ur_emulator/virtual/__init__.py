"""Virtual clock for emulated controllers and the processes of their clients, all in one process.

`scheduler` switches between actors and owns the time, `network` joins transports in memory, and `virtual_system` gives
both to every process as its operating system. `control` commands a controller as `ur_rtde` does. What runs on the
clock takes time and connections from its `System`.
"""
