"""Two controllers as a cell: the runner, one process per arm, and the supervisor that stops both.

    program ── RtdeCell ── Runner ──┬── arm process (left)  ── ur_rtde ──▶ left controller
                   │                ├── arm process (right) ── ur_rtde ──▶ right controller
                   │                └── supervisor ── own RTDE links, dashboard ──▶ both
                   └──────────── shared memory: targets, states, stops, latch ─────────────┘

Nothing else of the suite loads `ur_rtde`. No task and no policy is here, and the arm processes wait for neither.
"""
