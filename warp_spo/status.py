"""Why a world's result cannot be computed or trusted: one number a world, which ``status=`` arguments receive."""

import enum


class Status(enum.IntEnum):
    """The number that a call with ``status=`` writes for each world: the most severe state that holds in that world.

    ::

        status = np.zeros(dyn.worlds, np.int32)
        qdd = dyn.forward_dynamics(q, qd, tau, status=status)
        for number in np.unique(status):
            print(spo.Status(number).name, (status == number).sum(), spo.Status(number).advice)

    The numbers never change. They are not ordered by severity. From the most severe to the least severe the order is
    QUATERNION, NOT_FINITE, LOOPS, PIVOT, RANGE, UNSUPPORTED, SLOTS, OPEN, CONTACT, NOT_SETTLED, DIGITS, OK; see
    :attr:`severity`. QUATERNION, NOT_FINITE and PIVOT come with results that are NaN, or not to be trusted; RANGE and
    LOOPS do where numbers leave the range of the dtype or the rank is lost. With all others the result is finite, and
    off by what the name says.
    """

    OK = 0
    """The result can be trusted."""
    PIVOT = 1
    """The mass matrix is not positive definite to working precision. A pivot of its factorisation is not positive."""
    NOT_FINITE = 2
    """An input, or a value of the scene, is NaN or infinite in this dtype. Infinite limits and bounds are none."""
    DIGITS = 3
    """The result may keep fewer than half of the dtype's digits, by an estimate from above."""
    RANGE = 4
    """A pivot, a product that forms it, or the result is too small or too large for the dtype's normal numbers; or an
    angle is beyond 1e10 rad, or the squares of a quaternion's entries overflow or vanish."""
    NOT_SETTLED = 5
    """The last pass of a step ended with a limit or a friction law on another branch than the pass had assumed; or
    velocity terms of what the last round of a step with contacts found changed a rate by a tenth."""
    LOOPS = 6
    """The closures of the loops lose rank, or half of the dtype's digits. The mechanism is at a change point."""
    OPEN = 7
    """The closures of the loops do not hold after the step, in position or in velocity."""
    CONTACT = 8
    """The last pass of a step ended with a contact force outside of its law by more than the tolerance."""
    SLOTS = 9
    """More contacts were found than the scene has slots for; the surplus contacts were left out."""
    UNSUPPORTED = 10
    """Some contacts are of a kind that the solver cannot take; they were left out."""
    QUATERNION = 11
    """A quaternion among the coordinates is no rotation, because it is zero, or its square is below the normal numbers
    of the dtype."""

    @property
    def advice(self) -> str:
        """The way out, in one or two sentences."""
        return _ADVICE[self]

    @property
    def severity(self) -> int:
        """0 for OK; of two states that hold in one world, ``status=`` receives the one with the greater severity."""
        return _BY_SEVERITY.index(self)


_BY_SEVERITY = (
    Status.OK,
    Status.DIGITS,
    Status.NOT_SETTLED,
    Status.CONTACT,
    Status.OPEN,
    Status.SLOTS,
    Status.UNSUPPORTED,
    Status.RANGE,
    Status.PIVOT,
    Status.LOOPS,
    Status.NOT_FINITE,
    Status.QUATERNION,
)

_ADVICE = {
    Status.OK: "Nothing needs to be done.",
    Status.PIVOT: (
        "Give the joint armature or its body inertia: a massless leaf, three hinges at a gimbal lock and a point mass "
        "on a ball joint have no positive pivot. Use one ball joint in place of three hinges. In float32 many modes "
        "of a body with a heavy load leave none: use float64 or fewer modes."
    ),
    Status.NOT_FINITE: (
        "Look for the NaN or the infinity in what the call was given for this world (q, qd, tau, body_f, target_q, "
        "target_qd, ctrl and so on) and in the values passed to Dynamics.set, or for an actuator_delay longer than its "
        "buffers, or not a whole number, or a ground_field that the set of fields lacks; reset the world."
    ),
    Status.DIGITS: (
        "Use float64 for such worlds, give light links armature, and lay joint axes along the axes of their anchors. "
        "Where tau nearly cancels the other loads, compute and pass it in float64."
    ),
    Status.RANGE: (
        "Change the units of mass or length, use float64, take full turns off angles, or normalise quaternions."
    ),
    Status.NOT_SETTLED: "Use a shorter dt. The step stands, with a force that a shorter dt would correct.",
    Status.LOOPS: (
        "Use float64, or keep the mechanism away from configurations in which it can branch or lock. Cut the loops at "
        "other joints where every state has this word."
    ),
    Status.OPEN: (
        "Dynamics.project closes the state from which steps start. Otherwise use a shorter dt, or float64 where angles "
        "span many turns or places lie 100 m from the origin."
    ),
    Status.CONTACT: "Use a shorter dt or more passes, or lower the contact's stiffness.",
    Status.SLOTS: (
        "Build the scene with more contact slots. Pairs of bodies have slots by their number and their shapes, see "
        "Dynamics.explain(): fewer points that touch at once need fewer, such as of spheres and capsules for hulls."
    ),
    Status.UNSUPPORTED: "Take contacts of this kind out of the model, or give them shapes that the solver supports. "
    "For contacts between bodies list pairs: SolverSPO(model, pairs=...), or spo.Contact(..., other=...) in a scene.",
    Status.QUATERNION: (
        "Give q a quaternion that is not zero for this world, such as (0, 0, 0, 1) of a ball or free hinge that does "
        "not turn: q of zeros is no configuration, scene.neutral_q is one. Quaternions need not be of unit length."
    ),
}
