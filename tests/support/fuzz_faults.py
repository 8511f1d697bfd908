"""A loader with planted faults, for tests of benchmarks.fuzz: what it does is what the file's first word says."""

import os
import time
import types

import numpy as np


def load(file, floating=None, contacts=None, repair=True):
    """Read, refuse, raise, hang or end the process."""
    word = file.read_text().split()[0]
    if word == "hang":
        time.sleep(60.0)
    if word == "crash":
        os.abort()
    if word == "key":
        raise KeyError(word)
    if word == "nameless":
        raise ValueError("load: some file is wrong")
    if word == "bell":
        raise ValueError(f"load: {str(file)!r}: \a")
    if word == "refused":
        raise ValueError(f"load: {str(file)!r}: it is refused")
    value = np.nan if word == "nan" else 1.0
    return types.SimpleNamespace(values={"body_mass": np.array([[value]])})
