"""Reference motion of one arm, tick by tick, as a UR controller generates it.

All times are trajectory time, which the caller may advance more slowly than the clock, or stop. A motion whose whole
course is known is a *trajectory*: positions as a function of its time. Blends, and motions that start while the arm
moves, are sums of two trajectories, so that speeds have no jumps.
"""

from ur_emulator.motion.motion import MotionGenerator
from ur_emulator.motion.reference import Handle, MotionFault
from ur_emulator.motion.trajectories import JointTorques

__all__ = ["Handle", "JointTorques", "MotionFault", "MotionGenerator"]
