"""Cases that take seconds among tests that are otherwise quick: they run with the slow suite.

A name is a test, or one case of a parametrized test, as pytest writes it behind the folder.
"""

SLOW_CASES = (
    "test_adjoints.py::test_forward_dynamics[limbs-float64-segment]",
    "test_benchmark_parts.py::test_everything_goes_on_where_it_stopped",
    "test_benchmarks.py::test_capabilities_are_compared_with_references",
    "test_benchmarks.py::test_every_operation_of_every_scene_is_within_its_tolerance",
    "test_conservation.py::test_a_fast_top_by_the_integrators_order[midpoint]",
    "test_conservation.py::test_a_fast_top_by_the_integrators_order[rk4]",
    "test_dynamics.py::test_equals_reference[humanoid-float64]",
    "test_dynamics.py::test_same_bits_in_every_run_and_order[4097-mass_matrix_inverse]",
    "test_dynamics_derivatives.py::test_kernels[float64]",
    "test_dynamics_derivatives.py::test_products[float64]",
    "test_examples.py::test_gradients_through_500_steps_bring_hands_to_targets",
    "test_granularity.py::test_velocity_terms_first[hand-segment]",
    "test_granularity_values.py::test_everything_variable[tree]",
    "test_loop_calls.py::test_kernels_do_what_traces_do[float64]",
    "test_loop_files.py::test_an_example_runs[biped]",
    "test_loop_files.py::test_an_example_runs[stewart]",
    "test_loop_gradients.py::test_a_step_is_the_difference[far_loop]",
    "test_loop_ranks.py::test_a_ring_of_forty_bars",
    "test_loops.py::test_forward_dynamics_equals_lagrange[stewart]",
    "test_peers.py::test_harnesses_read_states_and_give_results",
    "test_peers.py::test_peers_compute_what_the_reference_says[quadruped-resolvent]",
    "test_reference_oracles.py::test_coordinates_are_newtons",
    "test_refinement.py::test_an_ill_conditioned_chain[float64-90-30000000.0]",
    "test_spatial_operators.py::test_sweeps_equal_the_dense_resolvent_at_4096_worlds[humanoid-float32]",
    "test_spatial_operators.py::test_sweeps_equal_the_dense_resolvent_at_4096_worlds[humanoid-float64]",
    "test_stress.py::test_digits_lost_are_estimated_from_above_and_not_far[float32]",
    "test_torch_rollouts.py::test_gradient_of_a_rollout_is_the_difference[damped_arm-500]",
    "test_trace_pieces.py::test_results_over_rows_that_warps_share[humanoid-mass_matrix_inverse]",
    "test_trace_pieces.py::test_warps_meet_at_barriers_alone[humanoid-forward_dynamics]",
    "test_trace_pieces.py::test_warps_meet_at_barriers_alone[tree20-forward_dynamics]",
)
