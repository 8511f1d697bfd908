"""Whether the ready tasks compute what their pages say: the same in NumPy. ``python -m benchmarks.mdp --help``.

``formulas`` has the quantities of a state, ``tasks`` the rewards, observations and ends of each task, ``rules`` what is
allowed for new starts, pushes and commands, and ``comparison`` steps an environment beside them.
"""
