"""Reference motion of one arm, tick by tick, as a UR controller generates it.

Everything here lives in trajectory time, which the caller lets pass slower than the clock, or not at all. A motion
that is known to its end is a *trajectory*: positions as a function of its time. Blends, and motions that start while
the arm moves, are sums of two trajectories, so that speeds have no jumps.
"""

from dual_ur10.sim2real.emulator.motion.motion import Motion
from dual_ur10.sim2real.emulator.motion.reference import Handle, MotionFault

__all__ = ["Handle", "Motion", "MotionFault"]
