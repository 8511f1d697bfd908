"""Dynamics against programs that no one here wrote: Pinocchio and MuJoCo.

First with models built from the scene's own numbers (oracles.py): the algorithms agree. Then with the models that the
oracle's own parser makes of the same robot file: the way from the file to the scene agrees, too.
"""

import functools

import mujoco
import numpy as np
import pinocchio as pin
import pytest

import warp_spo as spo
from support import laws, oracles, zoo
from support.granularities import of_random_scenes
from support.quick import slow_unless
from support.robots import ROBOTS, of_newtons_importer
from warp_spo.newton import shipped

WORLDS = 3

# Relative to the largest entry of the expected array, worst world.
BUILT = 1e-12  # float64 against float64; measured 1e-13 of forward dynamics (cond(Mass) 1e4), 1e-14 of the rest
PARSED = 1e-6  # Newton keeps a file's numbers in float32, 6e-8 each; measured 4e-7 of forward dynamics, 3e-7 otherwise

URDF_HUMANOID = shipped("humanoid").parents[2] / "tests" / "assets" / "humanoid.urdf"


# -- models built from the scene's numbers -----------------------------------------------------------------------------
def urdf_humanoid():
    """Bullet's humanoid, floating: chains of massless links stand for its hinges of two and three axes."""
    return spo.load(URDF_HUMANOID, floating=True)


def permuted_humanoid():
    """The humanoid with its bodies renumbered and its hinges reordered, children before parents."""
    scene = zoo.permuted(ROBOTS["humanoid"](), seed=5).scene
    assert any(hinge.parent > hinge.child for hinge in scene.hinges)
    return scene


def weighed_humanoid():
    """The same with links of a gram instead, for MuJoCo, which refuses a moving body without mass or inertia."""
    scene = urdf_humanoid()
    mass, inertia = scene.values["body_mass"], scene.values["body_inertia"]
    return scene.with_values(
        body_mass=np.maximum(mass, 1e-3),
        body_inertia=np.where(mass[..., None, None] > 0.0, inertia, 1e-5 * np.eye(3)),
    )


SCENES = ROBOTS | {
    "urdf_humanoid": urdf_humanoid,
    "weighed_humanoid": weighed_humanoid,
    "permuted_humanoid": permuted_humanoid,
    "two_robots": zoo.SCENES["forest"],
    "chain_ball": zoo.SCENES["chain_ball"],
    "every_d6": zoo.SCENES["every_d6"],
}
ORACLES = {"pinocchio": oracles.PinocchioModel, "mujoco": oracles.MujocoModel}
CASES = [(oracle, name) for oracle in ORACLES for name in SCENES if (oracle, name) != ("mujoco", "urdf_humanoid")]


@functools.cache
def scene_of(name):
    return SCENES[name]()


def disagreement(dyn, models, arrays):
    """Largest relative difference of each quantity over all worlds; ``models`` has the oracle of each world."""
    q, qd, qdd, tau = (arrays[name] for name in ("q", "qd", "qdd", "tau"))
    got = {
        "body_poses": dyn.body_poses(q),
        "mass_matrix": dyn.mass_matrix(q),
        "bias_force": dyn.bias_force(q, qd),
        "gravity_force": dyn.gravity_force(q),
        "inverse_dynamics": dyn.inverse_dynamics(q, qd, qdd),
        "forward_dynamics": dyn.forward_dynamics(q, qd, tau),
    }
    worst = dict.fromkeys(got, 0.0)
    for world, model in enumerate(models):
        state = q[world], qd[world]
        expected = {
            "body_poses": model.body_poses(q[world]),
            "mass_matrix": model.mass_matrix(q[world]),
            "bias_force": model.bias_force(*state),
            "gravity_force": model.bias_force(q[world], np.zeros_like(qd[world])),
            "inverse_dynamics": model.inverse_dynamics(*state, qdd[world]),
            "forward_dynamics": model.forward_dynamics(*state, tau[world]),
        }
        for name, wanted in expected.items():
            value = laws.same_quaternion_sign(name, dyn.scene, got[name][world], wanted)
            worst[name] = max(worst[name], laws.error(value, wanted))
    return worst


def agrees(dyn, models, tolerance, seed):
    worst = disagreement(dyn, models, laws.states(dyn.scene, dyn.worlds, seed))
    assert max(worst.values()) <= tolerance, {name: f"{error:.1e}" for name, error in worst.items()}


@pytest.mark.parametrize("armature", [True, False], ids=["armature", "bare"])
@pytest.mark.parametrize(("oracle", "name"), CASES)
def test_algorithms_agree(oracle, name, armature, device):
    """Without armature every number is the oracle's own; with it, see oracles.py for ball and free hinges."""
    scene = scene_of(name)
    scene = scene.with_values(joint_armature=np.full(scene.dof_count, 0.05 if armature else 0.0))
    granularity = of_random_scenes()  # robots have the plan's in the next test
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity=granularity)
    agrees(dyn, [ORACLES[oracle](scene)] * WORLDS, BUILT, seed=11)


@pytest.mark.parametrize("oracle", ORACLES)
@pytest.mark.parametrize("name", slow_unless(["arm", "two_robots"], ["humanoid", "arm", "two_robots"]))
def test_algorithms_agree_on_worlds_that_differ(name, oracle, device):
    """Masses, CoMs, inertias, anchors, armature and gravity of each world: one oracle a world."""
    scene = zoo.varied(scene_of(name), WORLDS)
    dyn = spo.Dynamics(scene, device=device, dtype="float64")
    agrees(dyn, [ORACLES[oracle](scene, world) for world in range(WORLDS)], BUILT, seed=12)


# -- models that the oracle's parser makes of a file -------------------------------------------------------------------
def name_in_file(label):
    """``robot/.../name`` -> name: the last part of a label that Newton's importers make."""
    return label.rpartition("/")[2]


class ParsedMjcf(oracles.MujocoModel):
    """MuJoCo's model of an MJCF file, in the coordinates of the scene of Newton's model of it.

    The joints of a body, in the file's order, are the degrees of freedom of its one hinge, whose label joins their
    names. Springs and dampers are switched off: forward and inverse dynamics contain none. Sensors are left out:
    nv_humanoid.xml has some on sites that it lacks, for which MuJoCo refuses the file.

    Raises:
        ValueError: a free joint with armature, which MuJoCo adds to the velocity of the body's origin, and a scene to
            that of its CoM.
    """

    def __init__(self, scene, path):
        oracles.Oracle.__init__(self, scene, 0)
        spec = mujoco.MjSpec.from_file(str(path))
        for sensor in list(spec.sensors):
            spec.delete(sensor)
        off = mujoco.mjtDisableBit
        spec.option.disableflags |= off.mjDSBL_CONSTRAINT | off.mjDSBL_SPRING | off.mjDSBL_DAMPER
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.outer_armature = np.zeros(scene.dof_count)  # the file's armature is in the model
        self.bodies = [self.model.body(name_in_file(label)) for label in scene.body_labels]
        self.com = [body.ipos for body in self.bodies]
        self.v_of, self.q_from = np.empty(scene.dof_count, dtype=int), np.empty(scene.coord_count, dtype=int)
        for h, hinge in enumerate(scene.hinges):
            coords, dofs = self.entries(h)
            body = self.bodies[hinge.child]
            joints = [self.model.joint(body.jntadr[0] + i) for i in range(body.jntnum[0])]
            if joints:
                if name_in_file(hinge.label) != "_".join(joint.name for joint in joints):
                    raise ValueError(f"ParsedMjcf: hinge {hinge.label!r} has the joints {[j.name for j in joints]}")
                if hinge.kind == "free" and joints[0].armature.any():
                    raise ValueError(f"ParsedMjcf: the free joint {joints[0].name!r} has armature")
                self.v_of[dofs] = joints[0].dofadr[0] + np.arange(len(dofs))
                self.q_from[coords] = joints[0].qposadr[0] + np.arange(hinge.coord_count)

    def body_poses(self, q):
        self._set(self.q_of(q), 0.0)
        mujoco.mj_kinematics(self.model, self.data)
        poses = [(*self.data.xpos[body.id], *np.roll(self.data.xquat[body.id], -1)) for body in self.bodies]
        return np.array(poses)


class ParsedUrdf(oracles.PinocchioModel):
    """Pinocchio's model of a URDF file, in the coordinates of the scene that ``load`` makes of it.

    Joints are found by name: Newton numbers the children of a link in the file's order, Pinocchio alphabetically. The
    coordinates of a continuous joint are its cosine and sine.
    """

    def __init__(self, scene, path, floating):
        oracles.Oracle.__init__(self, scene, 0)
        self.model = pin.buildModelFromUrdf(str(path), *([pin.JointModelFreeFlyer()] if floating else []))
        self.data = self.model.createData()
        assert self.model.check(self.data), "Pinocchio: joints not in depth-first order"
        self.outer_armature = np.zeros(scene.dof_count)  # a URDF has none
        self.frames = [self.model.getFrameId(name_in_file(label), pin.FrameType.BODY) for label in scene.body_labels]
        self.joints: dict[int, pin.JointModel] = {}  # by hinge
        self.v_of = np.empty(scene.dof_count, dtype=int)
        for h, hinge in enumerate(scene.hinges):
            dofs = self.entries(h)[1]
            if len(dofs):
                name = "root_joint" if hinge.kind == "free" else name_in_file(hinge.label)
                self.joints[h] = joint = self.model.joints[self.model.getJointId(name)]
                assert joint.nv == hinge.dof_count
                self.v_of[dofs] = np.arange(joint.idx_v, joint.idx_v + joint.nv)
            if hinge.kind == "free":
                self.com[hinge.child] = self.model.inertias[joint.id].lever
        assert len(self.joints) == self.model.njoints - 1

    def q_of(self, q):
        own = np.empty(self.model.nq)
        for h, joint in self.joints.items():
            mine = q[self.entries(h)[0]]
            if joint.nq == 2:
                mine = np.cos(mine[0]), np.sin(mine[0])
            own[joint.idx_q : joint.idx_q + joint.nq] = mine
        return own

    def body_poses(self, q):
        pin.framesForwardKinematics(self.model, self.data, self.q_of(q))
        return np.array([pin.SE3ToXYZQUAT(self.data.oMf[frame]) for frame in self.frames])


MJCF = """<mujoco model="probe">
  <compiler angle="radian"/><option gravity="0.5 -1 -7"/>
  <default><joint armature="0.01" damping="0.3" stiffness="2"/><geom density="700"/></default>
  <worldbody><body name="base" pos="0.1 0.2 0.3" quat="0.5 0.1 0.7 -0.4">
    <freejoint name="root"/>
    <geom name="box" type="box" size="0.1 0.2 0.05" pos="0.02 0.01 0" euler="0.3 0.2 -0.1"/>
    <geom name="can" type="cylinder" size="0.05 0.1" pos="0.1 0 0.1" quat="1 0.2 0.3 0"/>
    <body name="mast" pos="0.2 0.1 0" euler="0.4 -0.3 0.2">
      <joint name="lift" type="slide" axis="1 0 1" pos="0.01 0.02 0.03"/>
      <joint name="yaw" type="hinge" axis="0 1 0" pos="0.01 0.02 0.03"/>
      <inertial pos="0.03 -0.02 0.05" mass="1.3" fullinertia="0.02 0.03 0.025 0.001 -0.002 0.003"/>
      <body name="head" pos="0 0.1 0.2" axisangle="1 1 0 0.7">
        <joint name="neck" type="ball" pos="0.02 0 -0.03"/>
        <geom name="egg" type="ellipsoid" size="0.1 0.06 0.04" euler="0 0.5 0" mass="0.9"/>
        <body name="tip" pos="0.1 0 0.1">
          <joint name="nod" type="hinge" axis="1 2 -1" pos="0 0.05 0"/>
          <inertial pos="0 0.02 0.05" quat="0.9 0.1 -0.2 0.3" mass="0.4" diaginertia="0.004 0.003 0.002"/>
          <body name="pin" pos="0.05 0.05 0" euler="0 0 1">
            <geom type="capsule" fromto="0 0 0 0.1 0.1 0.05" size="0.02"/>
          </body>
        </body>
      </body>
    </body>
  </body></worldbody>
</mujoco>"""
"""Every joint type, shape and way to write a frame or an inertia that the shipped MJCF files leave out."""

URDF = """<robot name="probe">
  <link name="base"><inertial><origin xyz=".1 .02 -.03" rpy=".3 -.2 .5"/><mass value="3"/>
    <inertia ixx=".05" iyy=".06" izz=".07" ixy=".001" ixz="-.002" iyz=".003"/></inertial></link>
  <joint name="turn" type="continuous"><parent link="base"/><child link="drum"/>
    <origin xyz=".1 .2 .3" rpy=".4 .5 -.6"/><axis xyz="-1 0 2"/></joint>
  <link name="drum"><inertial><origin xyz=".1 0 .05" rpy="0 .7 0"/><mass value="2"/>
    <inertia ixx=".02" iyy=".03" izz=".04" ixy="0" ixz=".001" iyz="0"/></inertial></link>
  <joint name="weld" type="fixed"><parent link="drum"/><child link="bracket"/>
    <origin xyz="0 .1 .1" rpy="1 0 .2"/></joint>
  <link name="bracket"><inertial><origin xyz="0 .02 .05"/><mass value="1"/>
    <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="push" type="prismatic"><parent link="bracket"/><child link="rod"/>
    <origin xyz=".2 0 0" rpy="0 -.3 .9"/><axis xyz="0 -1 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="rod"><inertial><origin xyz="0 0 .1" rpy=".1 .2 .3"/><mass value=".5"/>
    <inertia ixx=".01" iyy=".012" izz=".013" ixy=".001" ixz="0" iyz="0"/></inertial></link>
  <joint name="bend" type="revolute"><parent link="bracket"/><child link="flap"/>
    <origin xyz="0 -.2 0"/><axis xyz="0 0 -1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="flap"><inertial><origin xyz=".1 .1 .1"/><mass value=".7"/>
    <inertia ixx=".011" iyy=".012" izz=".013" ixy=".001" ixz="0" iyz=".002"/></inertial></link>
</robot>"""
"""Turned frames, axes that are no unit vectors, a fixed joint with children: what the shipped URDF files leave out."""


def file_of(name, folder):
    """Path of a file by name; the two texts above are written to ``folder``."""
    texts = {"probe.xml": MJCF, "probe.urdf": URDF}
    if name in texts:
        (folder / name).write_text(texts[name])
        return folder / name
    return URDF_HUMANOID if name == "humanoid.urdf" else shipped(name)


def file_agrees(scene, model, device):
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64")
    agrees(dyn, [model] * WORLDS, PARSED, seed=13)


@pytest.mark.parametrize("name", ["humanoid", "ant", "probe.xml"])
def test_newtons_models_of_mjcf_are_as_mujoco_reads_the_file(name, tmp_path, device):
    """Masses from shapes and densities, inertias, frames, axes and armature, by ``from_newton``. Newton's importer
    does not read the file's gravity."""
    path = file_of(name, tmp_path)
    scene = of_newtons_importer(path)
    model = ParsedMjcf(scene, path)
    file_agrees(scene.with_values(gravity=model.model.opt.gravity), model, device)


@pytest.mark.parametrize("floating", [False, True], ids=["fixed", "floating"])
@pytest.mark.parametrize("name", ["quadruped", "humanoid.urdf", "probe.urdf"])
def test_urdf_is_read_as_pinocchio_reads_it(name, floating, tmp_path, device):
    path = file_of(name, tmp_path)
    scene = spo.load(path, floating=floating)
    file_agrees(scene, ParsedUrdf(scene, path, floating), device)


def test_fixed_cartpole_is_read_as_pinocchio_reads_it(device):
    scene = spo.load(shipped("cartpole"))
    file_agrees(scene, ParsedUrdf(scene, shipped("cartpole"), False), device)


def test_newton_weighs_a_link_without_inertial_by_its_shapes(device):
    """The floating cartpole differs in its slider alone: no mass as URDF has it, 1000 kg/m^3 times its box in Newton.

    With the slider's mass taken away the two agree, where Mass is singular and forward dynamics means nothing.
    """
    path = shipped("cartpole")
    scene = spo.load(path, floating=True)
    slider = scene.body_labels.index("cartpole/slider")
    np.testing.assert_allclose(scene.bodies[slider].mass, 1000.0 * 0.03 * 8.0 * 0.03, rtol=PARSED)
    values = {name: scene.values[name].copy() for name in ("body_mass", "body_inertia")}
    for array in values.values():
        array[:, slider] = 0.0
    scene = scene.with_values(**values)
    model, dyn = ParsedUrdf(scene, path, True), spo.Dynamics(scene, WORLDS, device=device, dtype="float64")
    arrays = laws.states(scene, WORLDS, seed=13)
    q, qd, qdd = (arrays[name] for name in ("q", "qd", "qdd"))
    mass, tau = dyn.mass_matrix(q), dyn.inverse_dynamics(q, qd, qdd)
    for world in range(WORLDS):
        assert laws.error(mass[world], model.mass_matrix(q[world])) <= PARSED
        assert laws.error(tau[world], model.inverse_dynamics(q[world], qd[world], qdd[world])) <= PARSED
