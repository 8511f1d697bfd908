"""The granularities of the recursions that tests run, and which of them serve a scene."""

import pytest

import warp_spo as spo
from warp_spo.errors import UnsupportedError

GRANULARITIES = ("node",)
"""A granularity that Dynamics accepts belongs here: the stress suite then runs on it."""


def skip_unless_served(scene, granularity):
    """Skip the test if Dynamics does not offer the granularity for the scene."""
    try:
        spo.Dynamics(scene, granularity=granularity)
    except UnsupportedError as error:
        pytest.skip(str(error))
