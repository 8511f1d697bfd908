"""What steps with contacts do and take: motions against promised figures, other engines, gradients, pictures.

``motions`` and ``courses``: every figure that contacts promise, on a CPU. ``mujoco``: G1 beside MuJoCo, its error
against run time. ``peers``: steps beside mujoco_warp and Newton's solvers, on a GPU. ``gradients``: their time, errors
and jumps. ``terrain``: a picture of the kinds of terrain. All but ``courses`` are commands.
"""
