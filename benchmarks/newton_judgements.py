"""Judgements of Newton's solver tests that fail with SolverSPO in their solver's place: whose fault, and why."""

NOT_OURS = "not ours"
IMPLICIT = "asserts the explicit Euler step; ours is implicit"
JUDGEMENTS: list[tuple[str, str, str]] = [
    (
        r"test_joint_drive\.",
        NOT_OURS,
        f"{IMPLICIT}: the slider's 10 m/s become 20 / 1.011 = 19.7824 m/s by (v + dt f) / (1 + dt kd/m + dt^2 ke/m), "
        "which is what comes out, where the test wants 19.9; the hinge's 35 / 1.0275 = 34.0633 rad/s for 34.75",
    ),
    (
        r"test_passive_spring_preload_and_drive",
        NOT_OURS,
        f"{IMPLICIT}, to 1e-6; and beyond a position limit SolverSPO's drive acts on, as its docstring says",
    ),
    (
        r"test_angular_spring_quaternion_sign_and_preload",
        NOT_OURS,
        "writes joint_rest_q without notify_model_changed; SolverSPO has values in its kernels until it is told",
    ),
    (
        r"test_spring_parameter_gradients",
        NOT_OURS,
        "gradients by joint_stiffness and joint_rest_q need variable=, which the test cannot name; a warning names it",
    ),
    (
        r"test_mimic_requires_shared_articulation",
        NOT_OURS,
        "wants Featherstone's refusal of mimics between articulations; SolverSPO holds them",
    ),
    (
        r"test_mimic_validates_gains",
        NOT_OURS,
        "wants SolverSemiImplicit's check of its own option joint_mimic_ke, which the stand-in leaves out",
    ),
    (
        r"test_rigid_contact\..*box_drop",
        NOT_OURS,
        "boxes of 1000 kg on Newton's default ke of 2500 N/m: SolverSPO takes ke as it is and warns that it cannot "
        "carry them; Newton runs the test with MuJoCo, XPBD and Steel alone",
    ),
    (
        r"test_rigid_contact\..*mesh_box_on_ground",
        NOT_OURS,
        "1000 kg on four points of 1e5 N/m and 1e3 N s/m that the test sets swing at 20 rad/s with a decay of 2 / s: "
        "0.058 m/s after its second, 0.0399 by implicit steps of 1/600 s, which is what comes out; it wants 0.01",
    ),
    (
        r"test_rigid_contact\..*convex_on_convex",
        NOT_OURS,
        "passes no contacts, because MuJoCo finds those itself; its ground is a plane of 10 m, which SolverSPO touches "
        "by lists of contacts alone, so that the body falls",
    ),
    (
        r"test_rigid_friction_ramp\.",
        NOT_OURS,
        "MuJoCo's variants pass no contacts, because MuJoCo finds those with boxes itself, so that bodies fall; those "
        "of XPBD give velocities to body_qd alone, where SolverSPO moves joint_qd",
    ),
    (
        r"test_native_solvers_follow_step_contacts",
        NOT_OURS,
        "wants MuJoCo's own detection in the caller's list of contacts; SolverSPO finds contacts with the ground "
        "itself and leaves that list alone",
    ),
    (
        r"test_oversized_observables_fill_legacy_force",
        NOT_OURS,
        "wants the deprecated array Contacts.force filled; SolverSPO has the observable contact_f alone",
    ),
    (
        r"test_penalty_friction_solver_step",
        NOT_OURS,
        "wants the deprecation warning of an option of SolverSemiImplicit",
    ),
]
"""(regular expression of the test, whose fault, why), the first that matches counts."""
