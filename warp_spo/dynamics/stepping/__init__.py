"""``Dynamics.step``: options, reports, integrators, contact, and gradients of a step."""
