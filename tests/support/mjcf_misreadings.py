"""Whether a scene has what MuJoCo has of an MJCF file: forces in random states, limits, loops, contacts, keyframes."""

import warnings

import mujoco
import numpy as np

import warp_spo as spo
from benchmarks.mjcf_files import Agreement
from support.mjcf_texts import EXACT
from warp_spo.reference.dense import Dense

ROUNDING = 1e-13  # relative error of an acceleration for each unit of the mass matrix's condition number
NEAR = 1e-9  # of poses, ranges and residuals of order one
AT_REST = 0.02  # relative error of a depth at rest, which is found to 6 % / 100 and on a limit that turns meanwhile
LIMIT, EQUALITY = (getattr(mujoco.mjtConstraint, f"mjCNSTR_{name}") for name in ("LIMIT_JOINT", "EQUALITY"))
WORLDS = 2  # states of a model; the first is qpos0
OFF = ("SPRING", "DAMPER", "FRICTIONLOSS", "EQUALITY", "ACTUATION", "CONTACT")


class DenseStates:
    """The calls of :class:`spo.Dynamics` that :class:`Agreement` makes, in NumPy: no kernel is compiled for a file."""

    def __init__(self, scene):
        self._scene, self._states = scene, {}

    def __getattr__(self, name):
        def call(q, *arguments):
            found = [self._one(name, row, *rest) for row, *rest in zip(q, *arguments, strict=True)]
            return np.stack(found)

        return call

    def _one(self, name, q, qd=None, *more):
        key = q.tobytes(), None if qd is None else qd.tobytes()
        if key not in self._states:
            self._states[key] = Dense(self._scene, q, qd)
        value = getattr(self._states[key], name)
        return np.array(value(qd, *more) if callable(value) else value)


def loaded(file, **options):
    """Return a file's scene and what the warnings about it say."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        scene = spo.load(file, **options)
    return scene, " ".join(str(one.message) for one in found if one.category is UserWarning)


def misreadings(file, model):
    """Return in words where the scene of a file is not what MuJoCo has in ``model``, and what the warnings say."""
    scene, said = loaded(file)
    touching, more = loaded(file, contacts="ground")
    rng = np.random.default_rng(0)
    both = Agreement(model, scene, WORLDS, granularity="node")
    both.dyn = DenseStates(scene)
    errors = both.errors()
    errors["passive"] = both.passive_error()
    errors["actuators"] = both.actuator_error(rng.normal(size=(WORLDS, model.nu)))
    bound = max(EXACT, ROUNDING * errors.pop("condition"))
    wrong = [f"{name}: {error:.1e}" for name, error in errors.items() if not error <= bound]
    for part in (_limits, _frictions, _loops, _couplings, _sites, _keyframes):
        wrong += [f"{part.__name__[1:]}: {words}" for words in part(model, scene, both)]
    return wrong + [f"contacts: {words}" for words in _contacts(model, touching)], f"{said} {more}"


def _close(ours, theirs, rtol=NEAR):
    return np.allclose(ours, theirs, rtol=rtol, atol=NEAR)


def _dof(scene, both, joint):
    """Return the index of a scalar joint's dof in a scene."""
    name = both.model.joint(joint).name
    labels = [label.split("/")[-1] for label in scene.dof_labels]
    return labels.index(name) if name else None


def _named(model):
    """Return the scalar joints that have names."""
    return [j for j in range(model.njnt) if model.joint(j).name and model.jnt_type[j] >= 2]


def _limits(model, scene, both):
    """Bounds are where MuJoCo's limits begin to push; there the joint rests under its weight, and as damped."""
    values, data = {name: array[0] for name, array in scene.values.items()}, mujoco.MjData(model)
    flags = model.opt.disableflags
    for name in OFF:
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    for joint in _named(model):
        dof, address = _dof(scene, both, joint), model.jnt_qposadr[joint]
        bounds = values["joint_limit_lower"][dof], values["joint_limit_upper"][dof]
        rests = []
        for bound, sign in zip(bounds, (-1.0, 1.0), strict=True):
            mujoco.mj_resetData(model, data)
            pushes = []
            for step in (-1e-7, 1e-7):
                data.qpos[address] = (bound if abs(bound) < 1e9 else sign * 1e3) + sign * step
                mujoco.mj_forward(model, data)
                rows = (data.efc_type == LIMIT) & (data.efc_id == joint)
                pushes.append(bool(rows.any()))
            if pushes != [False, abs(bound) < 1e9]:
                yield f"{model.joint(joint).name}: bound {bound} is not MuJoCo's {model.jnt_range[joint]}"
            elif abs(bound) < 1e9:
                k, b = data.efc_KBIP[np.flatnonzero(rows)[0], :2]
                ke, kd = values["joint_limit_ke"][dof], values["joint_limit_kd"][dof]
                inertia = 1.0 / model.dof_invweight0[model.jnt_dofadr[joint]]
                if not _close(kd / np.sqrt(ke * inertia), b / np.sqrt(k)):
                    yield f"{model.joint(joint).name}: another damping ratio"
                rests.append(_push_at_rest(model, data, joint, bound, sign, ke))
        rests = [rest for rest in rests if rest is not None]
        if len(rests) == 1 and model.body_parentid[model.jnt_bodyid[joint]] == 0 and not abs(rests[0]) < AT_REST:
            yield f"{model.joint(joint).name}: MuJoCo's acceleration at rest is {rests[0]:.1g} of that without limits"
    model.opt.disableflags = flags


def _push_at_rest(model, data, joint, bound, sign, ke):
    """Return MuJoCo's acceleration where the scene's limit rests, as a share of that without the limit, None if the
    weight does not push onto the limit."""
    dof, address, depth = model.jnt_dofadr[joint], model.jnt_qposadr[joint], 0.0
    for _ in range(30):
        data.qpos[address] = bound + sign * depth
        mujoco.mj_forward(model, data)
        depth = -sign * data.qfrc_bias[dof] / ke
        if depth <= 0.0:
            return None
    return data.qacc[dof] / data.qacc_smooth[dof]


def _frictions(model, scene, both):
    """Friction and evenly bounded forces are those of the dofs; MuJoCo has friction as rows of constraints."""
    data = both.data(1)
    loss = np.zeros(model.nv)
    rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
    loss[data.efc_id[rows]] = data.efc_frictionloss[rows]
    for joint in _named(model):
        ours, theirs = scene.values["joint_friction"][0, _dof(scene, both, joint)], loss[model.jnt_dofadr[joint]]
        if not _close(ours, theirs):
            yield f"{model.joint(joint).name}: {ours}, in MuJoCo {theirs}"


def _rows(model, data, name):
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_EQUALITY, name)
    return data.efc_pos[(data.efc_type == EQUALITY) & (data.efc_id == index)]


def _loops(model, scene, both):
    """A loop's gap is as long as MuJoCo's residual."""
    wanted = {model.equality(i).name for i in range(model.neq) if model.eq_type[i] <= 1}
    data, found = both.data(1), {loop.label: loop for loop in scene.loops}
    poses = both.dyn.body_poses(both.q)[1]
    for name in sorted(wanted):
        rows = _rows(model, data, name)
        if (len(rows) > 0) != (name in found):
            yield f"{name}: {len(rows)} rows in MuJoCo, loop {name in found}"
        elif len(rows):
            loop = found[name]
            ends = [
                composed(poses[body] if body >= 0 else np.eye(7)[6], pose)
                for body, pose in ((loop.parent, loop.parent_pose), (loop.child, loop.child_pose))
            ]
            if not _close(np.linalg.norm(ends[0][:3] - ends[1][:3]), np.linalg.norm(rows[:3])):
                yield f"{name}: another gap"
            index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_EQUALITY, name)
            scale = model.eq_data[index, 10] if len(rows) > 3 else 0.0
            if (loop.kind == "fixed") != (scale > 0.0):
                yield f"{name}: {loop.kind}, torquescale {scale}"
            elif scale:
                (u, w), (v, s) = ((end[3:6], end[6]) for end in ends)
                turn = np.linalg.norm(s * u - w * v - np.cross(v, u))
                if not _close(scale * turn, np.linalg.norm(rows[3:])):
                    yield f"{name}: another turn"


def _couplings(model, scene, both):
    """The residuals of couplings are MuJoCo's but for a factor: their ratios in two states are the same."""
    found = [c for c in scene.couplings]
    names = [model.equality(i).name for i in range(model.neq) if model.eq_type[i] in (2, 3)]
    residuals = {name: [_rows(model, both.data(world), name) for world in range(WORLDS)] for name in names}
    active = [name for name, rows in residuals.items() if len(rows[0])]
    if len(active) != len(found):
        yield f"{len(found)}, in MuJoCo {active}"
        return
    for name, coupling in zip(active, found, strict=True):
        follower, reference = (both.q[:, scene.q_start[hinge]] for hinge in (coupling.hinge, coupling.reference))
        ours = follower - coupling.offset - coupling.ratio * reference
        theirs = np.array(residuals[name])[:, 0]
        factor = theirs[1] / ours[1]
        if not _close(factor * ours, theirs):
            yield f"{name}: {ours}, in MuJoCo {theirs}"


def _sites(model, scene, both):
    data, poses = both.data(1), both.dyn.body_poses(both.q)[1]
    for index in range(model.nsite):
        body, pose = scene.sites[model.site(index).name]
        place = composed(poses[body], pose)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.roll(place[3:], 1))
        if not (_close(place[:3], data.site_xpos[index]) and _close(turn, data.site_xmat[index])):
            yield f"{model.site(index).name}: another pose"


def _keyframes(model, scene, both):
    tile = lambda array: np.tile(array, (both.worlds, 1))  # noqa: E731
    for index in range(model.nkey):
        key, qpos, qvel = scene.keyframes[model.key(index).name], model.key_qpos[index], model.key_qvel[index]
        q, qd = both.coordinates.q(tile(qpos))[0], both.coordinates.qd(tile(qpos), tile(qvel))[0]
        if not (_close(key.q, q) and _close(key.qd, qd) and _close(key.ctrl, model.key_ctrl[index])):
            yield f"{model.key(index).name}: another state"


def _contacts(model, scene):
    """The bodies that touch the floor, which is above all of them, and their friction are those of MuJoCo."""
    data, floor = mujoco.MjData(model), model.geom("floor").id
    mujoco.mj_forward(model, data)
    moves = lambda body: model.body_weldid[body] != 0  # noqa: E731
    theirs = {}
    for contact in data.contact:
        geom = max(contact.geom)
        if floor in contact.geom and moves(model.geom_bodyid[geom]) and contact.exclude == 0:
            friction = contact.friction[0] if contact.dim > 1 else 0.0
            theirs[geom] = (int(model.geom_bodyid[geom]) - 1, round(float(friction), 9))
    ours = {(contact.body, round(float(contact.friction), 9)) for contact in scene.contacts}  # a rounded box has nine
    if ours != set(theirs.values()):
        yield f"{sorted(ours)}, in MuJoCo {sorted(set(theirs.values()))}"


def composed(outer, inner):
    """Return the pose ``inner``, given in the pose ``outer``; quaternions are x, y, z, w."""
    place, turn = np.zeros(3), np.zeros(4)
    quaternion = np.roll(outer[3:], 1)
    mujoco.mju_rotVecQuat(place, np.array(inner[:3], float), quaternion)
    mujoco.mju_mulQuat(turn, quaternion, np.roll(inner[3:], 1))
    return np.concatenate([place + outer[:3], np.roll(turn, -1)])
