"""Scenes, truths to compare with, and checks that several test files share. No test file imports another one.

Scenes:
    ``zoo`` (trees of every kind of hinge), ``robots``, ``mechanisms`` and ``redundant_loops`` (closed loops),
    ``granularity_scenes`` and
    ``segments_of_trees`` (limbs side by side), ``value_scenes``, ``operator_scenes`` (weighted graphs, no robots),
    ``operators_of_robots``, ``border`` (one scene, arrays of all kinds), ``env_scenes``.
Joints and what drives them:
    ``custom_hinges``, ``hinge_twins`` (one mechanism written in two ways), ``geared``, ``actuated``.
Steps:
    ``step_scenes``, ``step_calls`` (options and reports by name), ``implicit`` (the dense nonlinear equation),
    ``rollouts``.
Contact with the ground:
    ``contact_cases``, ``contact_steps`` (the comparison with the dense step), ``contact_gradients``, ``hopping_leg``.
Contact between bodies:
    ``pair_scenes``, ``hull_scenes``, ``pair_touches`` (their points), ``pair_steps`` (the comparison with the dense
    step), ``pair_motions``.
Flexible bodies:
    ``flexible_scenes``, ``flexible_trees``, ``flexible_twin`` (a second implementation).
Newton's models and SolverSPO:
    ``newton_models``, ``solver_models``, ``solver_grounds``, ``solver_pair_models``.
Files:
    ``random_mjcf``, ``mjcf_texts``, ``mjcf_damage``, ``damage`` (of URDF), ``fuzz_faults`` (a loader that fails),
    ``usd_texts``. Attributes at random: ``mjcf_attributes`` and ``mjcf_misreadings`` (beside MuJoCo),
    ``urdf_attributes`` (beside Pinocchio), ``random_usd`` (beside OpenUSD).
Truths and laws:
    ``laws`` (of every operation), ``oracles`` (Pinocchio, MuJoCo), ``reference_cases``, ``closed_loops`` (Lagrange's
    equations), ``gradients`` (the operations that torch differentiates).
Traces and kernels without a compiler or a GPU:
    ``symbolic`` (traces evaluated by NumPy), ``warp_machine`` (the CUDA text of teams, run in Python),
    ``host_lanes`` (a warp as threads of the host), ``routines``, ``granularities``,
    ``mutants`` (kernel files with a planted bug), ``allocations``.
Others:
    ``quick`` (parameters of which a quick run takes some), ``benchmark_results``, ``rendering`` (pictures),
    ``typing_user``.
"""
