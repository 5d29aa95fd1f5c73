"""Images, pixel observations, the native viewer and the web viewer.

MuJoCo's renderer is loaded only when an image is rendered. What moves real arms never waits for an image.
"""
