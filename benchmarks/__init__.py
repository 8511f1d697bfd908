"""Benchmarks: error and run time of every operation on a handful of robots. ``python -m benchmarks --help``.

Each file that is a command says so in its first lines; CONTRIBUTING.md has the usual calls. ``command_line`` holds the
arguments that commands share.

The table of results:
    ``rows`` runs it, ``table/`` is the library behind it, ``peers/`` is what other libraries compute.
One question each, on a GPU:
    ``speed`` and ``limits`` (times beside limits), ``breakdown`` (launches of a call), ``plans`` (the
    plan's choice), ``depth`` (scans), ``variable`` (values that are read), ``substeps``, ``step_parts`` (SolverSPO's
    step), ``actuators``, ``flexible``, ``capabilities`` (other solvers), ``host_time``, ``jax_check``, ``many_gpus``.
Accuracy, mostly on a CPU:
    ``stress/``, ``stability`` (robots under gravity), ``spin`` (what turns freely), ``frames`` (where frames lie),
    ``gradients`` (rollouts), ``robot_files`` and ``mjcf_files`` (readers), ``robots_of_others`` (files that are not
    installed), ``joint_limits`` (of MJCF), ``fuzz`` (damaged files), ``inverse_kinematics``, ``flexible_peers``,
    ``boom`` (beams), ``newton_tests`` (Newton's own tests of solvers; ``newton_judgements`` of their failures).
Contact:
    ``contact/``: times and errors, energy, every promised figure, other engines, gradients, terrain.
Learning:
    ``env_times`` (parts of a step of an environment), ``actuator_nets`` (what learned actuators cost), ``training``
    (env-steps/s), ``learner`` (ways to learn, as graphs and not), ``threshold_times`` (from the command to a policy
    that does what is asked for), ``learning_curves``, ``watched_training`` (the price of a page, at which
    ``page_client`` looks, and of keeping failures), ``mdp/`` (do the ready tasks compute what their pages say?),
    ``guard`` (trainings with numbers that are spoilt), ``failures`` (their cost and the bits of replays),
    ``killed_trainings`` (``kill -9`` and ``--resume latest``; a CPU), ``installed_tasks`` (a package with tasks, by
    pip; a CPU), ``page_times`` (frames and the first picture of a page; a CPU).
Documentation and refactoring:
    ``blocks`` (code of pages), ``site``, ``site_pictures``, ``gallery``; ``kernel_texts`` (generated),
    ``env_digests`` (bits of the tasks' environments).
"""
