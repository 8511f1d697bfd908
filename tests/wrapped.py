"""A library of arrays that speaks DLPack and nothing else: its arrays are NumPy's inside.

It lies beside ``support`` because messages name a library by the package of its arrays.
"""

import numpy as np


class Array:
    """An array. Callers may ask for what the standard of DLPack says, a shape and a dtype."""

    def __init__(self, inside, device=(1, 0)):
        self.inside, self.device_here = inside, device
        self.shape, self.dtype = inside.shape, inside.dtype

    def __dlpack__(self, **options):
        return self.inside.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.device_here


def from_dlpack(array):
    return Array(np.from_dlpack(array))
