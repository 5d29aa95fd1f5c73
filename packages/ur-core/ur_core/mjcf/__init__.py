"""MJCF of one arm: its `MjSpec`, shape, gains and torque control. Scenes of several arms are composed elsewhere."""
