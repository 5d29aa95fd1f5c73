"""Viewers of a MuJoCo model, native and in a browser. What the model shows is not known here."""
