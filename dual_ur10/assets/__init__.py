"""The robot, the table and how they are composed into one MuJoCo model."""
