"""The simulated world of the arms: the interface to it, and that of a lone arm. Tasks and cells bring their own."""
