"""Steps with contacts: times, errors, energy, motions, other engines, gradients, pictures.

``scenes``: robots on the ground. ``steps``: time and error of a step; ``pairs``: the same where bodies touch bodies.
``joint_space``: those solved in joint space.
``throws``: energy of a million random states. ``defaults``: what rests, stands, holds and creeps on default values.
``spinning_contacts``: torsional and rolling friction beside closed forms and MuJoCo, on a CPU.
``motions`` and ``courses``: every figure that contacts promise, on a CPU. ``mujoco``: G1 beside MuJoCo, its error
against run time. ``peers``: steps beside mujoco_warp and Newton's solvers, on a GPU. ``gradients``: their time, errors
and jumps. ``terrain``: a picture of the kinds of terrain. ``shapes``: shapes on fields and planes beside truths.
``narrow_phase``: points of every pair of convex shapes beside truths, and their time on a GPU.
``uneven``: boxes and capsules on fields beside dense sampling, on a stair's edge and across a ridge. All but
``scenes`` and ``courses`` are commands. ``walkers``: robots of other packages thrown, and at rest beside MuJoCo.
"""
