"""Calibration of the bases: the right arm's `base` frame in the left one's, with its covariance.

Observations and their file, the estimator, suggestions of the next observation, boards of markers in images, and the
kinematics of Universal Robots' calibration files. All poses are in the left arm's own `base` frame, the one that its
pendant shows, unless a name says otherwise.

Nothing here moves an arm or writes a cell file; `recording` reads joint angles.
"""
