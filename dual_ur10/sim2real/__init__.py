"""Everything between an action and two arms: control, cell file, links and processes, records, and the emulator.

Layers, lowest first: `protocol`, `control` and `processes`; `config` and `links`; `peripherals` and `commissioning`;
`runtime`; `recording`. `analysis` and `emulator` are above `envs` and `policies`. The code that moves real arms never
imports the emulator.
"""
