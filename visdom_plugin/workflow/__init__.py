"""Functions for a script or a notebook that do what the commands do: load, check, carve, train, render, evaluate.

They are imported from `visdom_plugin` itself.
"""
