"""Scenes with actuators of every kind, and the MuJoCo model of one of them."""

import numpy as np

import warp_spo as spo

from .granularity_scenes import hand

INERTIA = np.diag([0.02, 0.03, 0.01])
MASS, COM, OFFSET = 1.0, (0.05, 0.02, -0.2), (0.0, 0.1, -0.4)
AXES = ((1, 0, 0), (0, 1, 0), (1, 0, 0))
ARM = """
<mujoco>
  <option integrator="implicitfast" timestep="{dt}" gravity="0 0 -9.81"/>
  <worldbody>
    <body pos="0 0 0"> <joint name="a" axis="1 0 0" armature="0.01" damping="0.1"/> {body}
      <body pos="{offset}"> <joint name="b" axis="0 1 0" armature="0.01" damping="0.1"/> {body}
        <body pos="{offset}"> <joint name="c" axis="1 0 0" armature="0.01" damping="0.1"/> {body} </body>
      </body>
    </body>
  </worldbody>
  <tendon> <fixed name="t"> <joint joint="a" coef="0.7"/> <joint joint="c" coef="-1.2"/> </fixed> </tendon>
  <actuator> {actuators} </actuator>
</mujoco>
"""
KINDS = {
    "motor": (spo.Actuator(0, gear=2.0), '<motor joint="a" gear="2"/>'),
    "motor with ranges": (
        spo.Actuator(1, gear=-3.0, gain=1.0, ctrl_range=(-0.8, 0.5), force_range=(-0.6, 1.0)),
        '<motor joint="b" gear="-3" ctrlrange="-0.8 0.5" forcerange="-0.6 1.0"/>',
    ),
    "position": (
        spo.Actuator(1, gain=20.0, bias=(0.0, -20.0, -1.5), force_range=(-8.0, 8.0)),
        '<position joint="b" kp="20" kv="1.5" forcerange="-8 8"/>',
    ),
    "position with gear": (
        spo.Actuator(2, gear=-5.0, gain=4.0, bias=(0.0, -4.0, 0.0), ctrl_range=(-1.0, 1.0)),
        '<position joint="c" kp="4" gear="-5" ctrlrange="-1 1"/>',
    ),
    "velocity": (spo.Actuator(2, gear=1.5, gain=3.0, bias=(0.0, 0.0, -3.0)), '<velocity joint="c" kv="3" gear="1.5"/>'),
    "affine": (
        spo.Actuator(0, gear=0.5, gain=2.5, bias=(0.3, -1.1, 0.2), force_range=(-4.0, 6.0)),
        '<general joint="a" gear="0.5" gainprm="2.5" biastype="affine" biasprm="0.3 -1.1 0.2" forcerange="-4 6"/>',
    ),
    "tendon motor": (spo.Actuator((0, 2), gear=(1.4, -2.4)), '<motor tendon="t" gear="2"/>'),
    "tendon servo": (
        spo.Actuator((0, 2), gear=(0.7, -1.2), gain=9.0, bias=(0.0, -9.0, -0.5), force_range=(-5.0, 5.0)),
        '<position tendon="t" kp="9" kv="0.5" forcerange="-5 5"/>',
    ),
}
"""Name -> the actuator, and MuJoCo's."""
CURVES = (
    spo.Actuator(0, gain=2.0, torque_speed=(3.0, 4.0), strength=0.8),
    spo.Actuator(2, gear=-2.0, gain=6.0, bias=(0.1, -6.0, -0.4), torque_speed=(4.0, 9.0), force_range=(-3.5, 3.0)),
    spo.Actuator((0, 1, 2), gear=(0.5, -1.0, 2.0), gain=5.0, torque_speed=(2.0, 6.0)),
)
"""Motors with torque-speed curves: alone, as a servo, and on several hinges."""


def arm(actuators, **values):
    """Three links on revolute hinges, with these actuators."""
    hinges = [
        spo.Hinge("revolute", k - 1, k, axis=axis, parent_pose=(*at, 0, 0, 0, 1), armature=0.01, damping=0.1)
        for k, (axis, at) in enumerate(zip(AXES, ((0, 0, 0), OFFSET, OFFSET), strict=True))
    ]
    bodies = [spo.Body(MASS, COM, INERTIA) for _ in AXES]
    scene = spo.Scene(bodies, hinges, actuators=actuators)
    return scene.with_values(**values) if values else scene


def mujoco_arm(actuators, dt=1e-3, limits=()):
    """The same in MuJoCo, with these elements; ``limits`` are the joints' effort limits."""
    import mujoco

    text = lambda numbers: " ".join(map(str, numbers))  # noqa: E731
    body = f'<inertial pos="{text(COM)}" mass="{MASS}" diaginertia="{text(np.diag(INERTIA))}"/>'
    arm_text = ARM.format(dt=dt, body=body, offset=text(OFFSET), actuators=" ".join(actuators))
    for name, limit in zip("abc", limits, strict=False):
        joint = f'<joint name="{name}" axis'
        arm_text = arm_text.replace(joint, joint.replace("axis", f'actuatorfrcrange="{-limit} {limit}" axis'))
    return mujoco.MjModel.from_xml_string(arm_text)


def everything(**values):
    """The arm with all actuators."""
    return arm([actuator for actuator, _ in KINDS.values()] + list(CURVES), **values)


def driven(scene):
    """The scene with a motor on one hinge, and another on two."""
    first, second = [i for i, hinge in enumerate(scene.hinges) if hinge.coord_count == 1][:2]
    motors = spo.Actuator(first, gear=2.0), spo.Actuator((first, second), gear=(1.0, -0.5), force_range=(-1.0, 0.5))
    return with_actuators(scene, motors)


def with_actuators(scene, actuators):
    """The scene, at its values, with these actuators."""
    values = {name: value for name, value in scene.values.items() if not name.startswith("actuator")}
    parts = dict(loops=scene.loops, couplings=scene.couplings, actuators=actuators)
    return spo.Scene(scene.bodies, scene.hinges, **parts).with_values(**values)


def slider(*actuators, **hinge):
    """A mass of 2 kg on rails without gravity, so that h f / 2 is what a force f adds to its rate."""
    hinge = spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0), **hinge)
    return spo.Scene([spo.Body(2.0, inertia=np.eye(3))], [hinge], gravity=(0, 0, 0), actuators=actuators)


def states(scene, worlds, seed=0):
    """Random q, qd, and controls of which some leave their ranges."""
    rng = np.random.default_rng(seed)
    q, qd = rng.normal(size=(worlds, scene.coord_count)), 4.0 * rng.normal(size=(worlds, scene.dof_count))
    return q, qd, 2.0 * rng.normal(size=(worlds, len(scene.actuators)))


def alike_hand():
    """Fingers that are alike but for their numbers."""
    scene, rng = hand(), np.random.default_rng(3)
    names = "joint_target_ke", "joint_effort_limit", "joint_friction"
    return scene.with_values(**{name: rng.uniform(1.0, 9.0, scene.dof_count) for name in names})


def driven_hand():
    """The fingers with a servo at each hinge, a tendon from one to another, and a motor along its curve."""
    scene = alike_hand()
    joints = [i for i, hinge in enumerate(scene.hinges) if hinge.coord_count == 1]
    servos = [spo.Actuator(i, -0.5, 9.0, (0.1, -9.0, -0.2), force_range=(-0.6, 0.3 + 0.1 * i)) for i in joints]
    others = (spo.Actuator(joints[1:4], (0.3, -0.2, 0.4), 2.0, (0.0, -2.0, -0.1), force_range=(-0.4, 0.4)),
              spo.Actuator(joints[0], 0.2, torque_speed=(1.0, 3.0)))  # fmt: skip
    return with_actuators(scene, [*servos, *others])
