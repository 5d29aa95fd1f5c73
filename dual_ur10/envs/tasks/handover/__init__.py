"""Handover: one arm picks up a block, hands it over, and the other places it. No policy is here."""
