"""Two controllers as a cell: the runner, one process per arm, and the supervisor that stops both.

    program ── RtdeCell ── Runner ──┬── arm process (left)  ── ur_rtde ──▶ left controller
                   │                ├── arm process (right) ── ur_rtde ──▶ right controller
                   │                └── supervisor ── own RTDE links, dashboard ──▶ both
                   └──────────── shared memory: targets, states, stops, latch ─────────────┘

The only package that loads `ur_rtde`. Imports the lower layers of `sim2real`, never `ur_emulator`. Environments load it
only for a cell of controllers.
"""
