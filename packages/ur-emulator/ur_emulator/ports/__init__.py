"""Ports of a controller, where UR has them: dashboard, primary, real-time and RTDE interfaces, and grippers.

Bytes of others end here. Nothing in this room computes motion.
"""
