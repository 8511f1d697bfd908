"""Parameters of which a quick run takes some and ``.ci/run`` all."""

import pytest


def slow_unless(quick, values):
    """Return ``values`` as parameters of a test; those that are not in ``quick`` are marked slow.

    Args:
        quick: values that a quick run takes; each must be one of ``values``.
        values: all values; tuples are parameters of several arguments.
    """
    quick, values = list(quick), list(values)
    unknown = [value for value in quick if value not in values]
    assert not unknown, f"slow_unless: {unknown} are no parameters of the test; expected some of {values}"
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)), marks=[pytest.mark.slow] * (value not in quick)
        )
        for value in values
    ]
