"""Methods that the shipped tables name and that are not built here: their rows stay "not available".

A package that offers one under its name fills its rows.
"""

NOT_BUILT = ("zerorf", "splatfields", "fsgs", "gaussianobject", "gaussianobject+vd")
