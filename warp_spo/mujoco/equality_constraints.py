"""Equality constraints of a MuJoCo model as loops and couplings, exact here where they are soft there."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from ..scene.parts import Coupling, Loop
from .mechanism import Mechanism, xyzw
from .source import Source

CONNECT, WELD, JOINT, TENDON, DISTANCE = (
    int(getattr(mujoco.mjtEq, f"mjEQ_{name}")) for name in ("CONNECT", "WELD", "JOINT", "TENDON", "DISTANCE")
)
SITE = int(mujoco.mjtObj.mjOBJ_SITE)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def read_equality_constraints(source: Source, mechanism: Mechanism) -> tuple[list[Loop], list[Coupling]]:
    """Return the loops and the couplings of the active equality constraints.

    A connect is a ball, a weld is fixed. A joint equality of first order is a coupling, and so is a tendon equality in
    which two joints take part.

    Raises:
        UnsupportedError: an equality is of another kind; the message names it.
    """
    m = source.model
    loops: list[Loop] = []
    couplings: list[Coupling] = []
    for index in range(m.neq):
        kind, words = int(m.eq_type[index]), source.words("equality", index)
        if not m.eq_active0[index] or source.disabled("EQUALITY") or source.disabled("CONSTRAINT"):
            source.left_out.append(f"{words}, which is not active")
        elif kind in (CONNECT, WELD):
            loop = _loop(source, index, kind)
            if loop is None:
                source.left_out.append(f"{words}, between bodies that do not move against each other")
            else:
                loops.append(loop)
        elif kind in (JOINT, TENDON):
            couplings.append(_coupling(source, mechanism, index, kind))
        else:
            name = {DISTANCE: "a distance"}.get(kind, "a flex")
            source.refuse(f"{words}, {name} equality,", "remove it, or close the loop with connect or weld")
    return loops, couplings


def fixed_tendon(source: Source, tendon: int) -> dict[int, float]:
    """Return the coefficient of each joint in the length of a fixed tendon."""
    m = source.model
    found: dict[int, float] = {}
    for place in range(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon]):
        joint = int(m.wrap_objid[place])
        found[joint] = found.get(joint, 0.0) + float(m.wrap_prm[place])
    return {joint: coefficient for joint, coefficient in found.items() if coefficient}


def _loop(source: Source, index: int, kind: int) -> Loop | None:
    """Return the loop of a connect or weld, None if its bodies are fixed to each other or to the world."""
    m = source.model
    objects, data = (int(m.eq_obj1id[index]), int(m.eq_obj2id[index])), m.eq_data[index]
    ends: list[tuple[int, Any]]
    if m.eq_objtype[index] == SITE:
        ends = [(int(m.site_bodyid[s]), (*m.site_pos[s], *xyzw(m.site_quat[s]))) for s in objects]
    elif kind == CONNECT:
        ends = [(objects[0], (*data[:3], *UPRIGHT)), (objects[1], (*data[3:6], *UPRIGHT))]
    else:
        ends = [(objects[0], (*data[3:6], *xyzw(data[6:10]))), (objects[1], (*data[:3], *UPRIGHT))]
    carriers = {int(m.body_weldid[body]) for body, _ in ends}
    if len({0 if m.body_mocapid[carrier] >= 0 else carrier for carrier in carriers}) == 1:
        return None
    if ends[1][0] == 0:
        ends.reverse()
    (parent, parent_pose), (child, child_pose) = ends
    turns = kind == CONNECT or data[10] == 0.0  # a weld of torquescale 0 does not hold the orientation
    label = source.label("equality", index, f"equality_{index}")
    return Loop(
        "ball" if turns else "fixed",
        parent - 1,
        child - 1,
        parent_pose=parent_pose,
        child_pose=child_pose,
        label=label,
    )


def _coupling(source: Source, mechanism: Mechanism, index: int, kind: int) -> Coupling:
    """Return the coupling of a joint or tendon equality: a sum of two coordinates, each by its factor, is constant."""
    m, words = source.model, source.words("equality", index)
    data = m.eq_data[index]
    if np.any(data[2:5]):
        source.refuse(f"{words}, a polynomial of degree two or more,", "keep the first two coefficients of polycoef")
    first, second = int(m.eq_obj1id[index]), int(m.eq_obj2id[index])
    terms = (lambda i: {i: 1.0}) if kind == JOINT else (lambda i: fixed_tendon(source, i))
    total = dict(terms(first))
    if second >= 0:
        for joint, factor in terms(second).items():
            total[joint] = total.get(joint, 0.0) - float(data[1]) * factor
    used = [joint for joint, factor in total.items() if factor]
    if second >= 0 and kind == JOINT:
        used = [first, second]  # a slope of zero included
    if len(used) != 2 or first == second:
        source.refuse(
            f"{words}, which ties {len(used)} joint(s),",
            "expected two joints of one coordinate; lock one joint by leaving it out of its body",
        )
    follower, reference = used
    # factor_f (q_f - ref_f) + factor_r (q_r - ref_r) = polycoef[0]
    hinge, base = (mechanism.joint_hinge(joint, words) for joint in used)
    ratio = -total[reference] / total[follower]
    refs = [float(m.qpos0[m.jnt_qposadr[joint]]) for joint in used]
    offset = refs[0] + float(data[0]) / total[follower] - ratio * refs[1]
    return Coupling(hinge, base, ratio=ratio, offset=offset)
