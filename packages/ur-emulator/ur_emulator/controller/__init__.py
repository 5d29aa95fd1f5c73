"""One controller, one control period at a time: safety, programs, registers, inputs and outputs, and its pendant.

It knows of no port and no clock. `profile` says what is known of each software version, and what is assumed.
"""
