"""Checks and preparation of a cell: doctor, power, and prompts to the operator. Nothing here commands motion."""
