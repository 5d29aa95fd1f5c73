"""MuJoCo models: arm, tools, props, obstacles, the scene composed of them, and the collision model of the gate.

What holds for one arm or tool of any suite is not here, and neither is what a task does with a model.
"""
