"""Sine tracking: each flange follows a sinusoidal reference."""
