"""Recorded runs put to use: compared with each other, played again, and fitted to the law of `servoj`."""
