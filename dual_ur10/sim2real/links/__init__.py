"""Client connections to a UR controller that only read: RTDE, dashboard and primary interface.

Imports `sim2real.protocol`. Imported by `peripherals`, `commissioning` and `runtime`.
"""
