"""Injection of faults into arm, program, network and clock, and the requests that ask for them."""
