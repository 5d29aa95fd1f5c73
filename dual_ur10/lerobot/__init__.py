"""LeRobot datasets: export of recorded runs, and datasets of others in simulation."""
