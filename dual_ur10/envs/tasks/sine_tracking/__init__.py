"""Sine tracking: each flange follows a sinusoidal reference. No policy that tracks it is here."""
