"""Tests whether a method keeps the promises of `training.protocols.Method` and `hooks.protocols`.

    pytest --pyargs visdom_plugin.conformance --method NAME

trains the method's quick preset for a few dozen steps on small pictures of the built-in scene, on the CPU, and
says of each promise that is not kept what was seen, where it is written, and what to do. NAME is any name that
`visdom-methods` shows, without its variant; `--method` may be given several times.
"""
