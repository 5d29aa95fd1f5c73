"""Universal Robots arms: models, kinematics, control kernel, controller protocols, and MJCF of arms and tools."""

__version__ = "0.1.0"
