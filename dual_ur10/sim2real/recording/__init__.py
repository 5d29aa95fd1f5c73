"""Records of runs: MCAP writer and reader, the recorder process, and the black box.

Imports `sim2real.{config, control, runtime}`; imported by `envs.core`, `policies` and `sim2real.analysis`.
"""
