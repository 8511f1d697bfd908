"""The granularities of the recursions that tests run, and which of them serve a scene."""

import pytest

import warp_spo as spo
from warp_spo.errors import UnsupportedError
from warp_spo.execution import plan

GRANULARITIES = ("node", "tree", "segment")
"""A granularity that Dynamics accepts belongs here: the stress suite then runs on it."""
SLOW = ("tree", "segment")
"""Those that compile a kernel for each scene."""


def of_random_scenes():
    """Return the granularity for scenes of the zoo: the one that ``--granularity`` names, node if it names the plan."""
    return plan.DEFAULT or "node"


def skip_unless_served(scene, granularity):
    """Skip the test if Dynamics does not offer the granularity for the scene, or would compile it for too long."""
    if granularity in SLOW and scene.dof_count > plan.MOST_DOFS:
        pytest.skip(f"{scene.dof_count} dof: the plan leaves more than {plan.MOST_DOFS} to node granularity")
    try:
        spo.Dynamics(scene, granularity=granularity)
    except UnsupportedError as error:
        pytest.skip(str(error))
