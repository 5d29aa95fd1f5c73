"""Records of runs: MCAP writer and reader, the recorder process, and the black box.

Imports `sim2real.{config, control, runtime}`. Environments load it only where there is something to record.
"""
