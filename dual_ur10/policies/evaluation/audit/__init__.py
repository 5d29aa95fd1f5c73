"""Audit of tasks: what makes one unlearnable or dishonest."""
