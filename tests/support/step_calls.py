"""Calls of ``Dynamics.step`` whose options and reports a test collects by name."""

import warp_spo as spo
from warp_spo.dynamics.stepping.options import OPTIONS, REPORT


def bundled(**given):
    """Arguments of a step, where options and reports, given by their own names, are in the objects that it takes."""
    options, report = ({n: given.pop(n) for n in one.members if n in given} for one in (OPTIONS, REPORT))
    given |= {"options": spo.StepOptions(**options)} if options else {}
    return given | ({"report": spo.StepReport(**report)} if report else {})
