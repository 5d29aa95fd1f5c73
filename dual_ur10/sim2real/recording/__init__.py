"""Records of runs: MCAP writer and reader, the recorder process, and the black box.

Environments load it only where there is something to record. What moves arms never waits for a disk. The bytes that
`encoding` writes are a promise: a change of them changes `FORMAT` in `header`.
"""
