"""From an action to two arms: control, the cell file, links and processes of real arms, records, and the emulator.

Imports run from `protocol`, `control` and `processes` to `config` and `links`, to `peripherals`, `commissioning` and
`runtime`, to `recording`; `analysis` and `emulator` stand above `envs` and `policies`. Nothing that moves real arms
imports the emulator.
"""
