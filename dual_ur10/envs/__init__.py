"""Tasks, the simulated cell, and the environments made of both."""
