"""Images, pixel observations, the native viewer and the web viewer.

Imports `assets` and `envs.core`; loads MuJoCo's renderer only when an image is rendered.
"""
