"""Everything between an action and two arms: control, cell file, links and processes, and records.

Layers, lowest first: `protocol`, `control` and `processes`; `config` and `links`; `peripherals` and `commissioning`;
`runtime`; `recording`. `analysis` is above `envs` and `policies`. Nothing here imports the emulated controllers of
`ur_emulator`, which are above all of it.
"""
