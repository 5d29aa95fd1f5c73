"""Dual UR10 environments for learned and scripted two-arm policies, in MuJoCo and on real arms."""

__version__ = "0.1.0"
