"""Actuators of a MuJoCo model: forces on joints that a control commands."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from ..scene.actuators import UNBOUNDED, Actuator
from .equality_constraints import fixed_tendon
from .mechanism import SIZES, TO_JOINT, Mechanism, actuator_output
from .source import Source

WORDS = {
    "mjTRN_SLIDERCRANK": "a slider-crank transmission",
    "mjTRN_SITE": "a site transmission",
    "mjTRN_BODY": "a body transmission (adhesion)",
    "mjTRN_SO3": "a transmission of orientation",
}
TO_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
WAY_OUT = "remove it, or compute its force and pass it as tau"


def read_actuators(source: Source, mechanism: Mechanism) -> list[Actuator]:
    """Return the actuators in the model's order.

    Raises:
        UnsupportedError: an actuator has activation states, a gain that depends on its length, or another transmission
            than to scalar joints; the message names it.
    """
    model = source.model
    count = source.count("nactuator") or model.nu
    for actuator in range(count):
        _refuse_actuator(source, actuator)
    joints = [_transmission(source, actuator) for actuator in range(count)]
    ranges = _force_ranges(source, joints)
    off = [actuator for actuator in range(count) if _is_off(source, actuator)]
    if off:
        names = ", ".join(source.words("actuator", actuator) for actuator in off)
        source.left_out.append(f"the forces of {names}, which the options disable (their strength is 0)")
    limited = model.actuator_ctrllimited.astype(bool) & (not source.disabled("CLAMPCTRL"))
    found = []
    for actuator, gears in enumerate(joints):
        gain, bias = _gain_and_bias(source, actuator)
        found.append(
            Actuator(
                [mechanism.joint_hinge(joint, source.words("actuator", actuator)) for joint in gears],
                gear=list(gears.values()),
                gain=gain,
                bias=bias,
                ctrl_range=model.actuator_ctrlrange[actuator] if limited[actuator] else UNBOUNDED,
                force_range=ranges[actuator],
                strength=0.0 if actuator in off else 1.0,
                label=source.label("actuator", actuator, f"actuator_{actuator}"),
            )
        )
    return found


def _refuse_actuator(source: Source, actuator: int) -> None:
    m, words = source.model, source.words("actuator", actuator)
    kinds = {name: int(getattr(m, f"actuator_{name}type")[actuator]) for name in ("gain", "bias", "dyn", "trn")}
    gain, bias, dynamics, transmission = (enum(kind) for enum, kind in zip(_enums(), kinds.values(), strict=True))
    if "mjGAIN_MUSCLE" == gain.name or "mjBIAS_MUSCLE" == bias.name:
        source.refuse(f"{words}, a muscle,", WAY_OUT)
    if gain.name == "mjGAIN_DCMOTOR":
        if not _is_plain_motor(source, actuator):
            what = "cogging, friction, inductance, heat, a controller or a limited voltage"
            source.refuse(f"{words}, a DC motor with {what},", WAY_OUT)
    elif dynamics.name != "mjDYN_NONE":
        state = dynamics.name.removeprefix("mjDYN_").lower()
        source.refuse(f"{words}, which has an activation state (dyntype {state}),", WAY_OUT)
    elif gain.name not in ("mjGAIN_FIXED", "mjGAIN_AFFINE") or bias.name not in ("mjBIAS_NONE", "mjBIAS_AFFINE"):
        source.refuse(f"{words}, whose force is {gain.name[7:].lower()} with {bias.name[7:].lower()} bias,", WAY_OUT)
    if gain.name == "mjGAIN_AFFINE" and np.any(m.actuator_gainprm[actuator, 1:3]):
        source.refuse(f"{words}, whose gain depends on its length or velocity,", WAY_OUT)
    if transmission.name in WORDS:
        source.refuse(f"{words}, which has {WORDS[transmission.name]},", WAY_OUT)


def _is_plain_motor(source: Source, actuator: int) -> bool:
    """Whether a DC motor has a resistance R and a constant K alone, and a voltage V: its force is K (V - K l') / R."""
    m, inputs = source.model, source.field("actuator_ctrlspec")
    named = getattr(mujoco, "mjtCtrlInput", None)  # MuJoCo 3.11 has no names of inputs; its 0 is the voltage
    if inputs is None or inputs[actuator] != (0 if named is None else named.mjINPUT_VOLTAGE):
        return False
    more = m.actuator_gainprm[actuator, 2:], m.actuator_biasprm[actuator], m.actuator_dynprm[actuator]
    return not any(map(np.any, more)) and not m.actuator_actnum[actuator]


def _gain_and_bias(source: Source, actuator: int) -> tuple[float, Any]:
    """Return gain and bias of an actuator that was not refused."""
    m = source.model
    if mujoco.mjtGain(m.actuator_gaintype[actuator]).name == "mjGAIN_DCMOTOR":
        resistance, constant = m.actuator_gainprm[actuator, :2].tolist()
        return constant / resistance, (0.0, 0.0, -constant * constant / resistance)
    affine = m.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
    return m.actuator_gainprm[actuator, 0], m.actuator_biasprm[actuator, :3] if affine else (0.0, 0.0, 0.0)


def _enums() -> tuple:
    return mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtDyn, mujoco.mjtTrn


def _transmission(source: Source, actuator: int) -> dict[int, float]:
    """Return the gear to each joint on which an actuator acts."""
    m, words = source.model, source.words("actuator", actuator)
    target, kind = int(m.actuator_trnid[actuator, 0]), int(m.actuator_trntype[actuator])
    gear = m.actuator_gear[actuator_output(source, actuator)]
    if kind in TO_JOINT:
        if SIZES[int(m.jnt_type[target])][1] != 1:
            source.refuse(
                f"{words}, which acts on {source.words('joint', target)}, a ball or free joint,",
                "remove it and pass its force as tau, or replace the joint by hinges",
            )
        return {target: float(gear[0])}
    if kind != TO_TENDON:
        source.refuse(f"{words}, which has no transmission,", WAY_OUT)
    for name in ("armature", "damping"):
        values = source.field(f"actuator_{name}")
        if values is not None and values[actuator]:
            source.refuse(f"{words}, which has {name} on a tendon,", f"remove it, or put {name} on the joints")
    return {joint: gear[0] * factor for joint, factor in fixed_tendon(source, target).items()}


def _force_ranges(source: Source, joints: list[dict[int, float]]) -> list[tuple[float, float]]:
    """Return the range of each actuator's force, narrowed by an uneven ``actuatorfrcrange`` of a joint that it alone
    drives. An even one is the joint's effort limit, which bounds the sum of its actuators."""
    m = source.model
    ranges = [
        tuple(m.actuator_forcerange[actuator].tolist()) if m.actuator_forcelimited[actuator] else UNBOUNDED
        for actuator in range(len(joints))
    ]
    for joint in np.flatnonzero(m.jnt_actfrclimited):
        if m.jnt_actfrcrange[joint, 0] == -m.jnt_actfrcrange[joint, 1]:
            continue
        own = [actuator for actuator, gears in enumerate(joints) if gears.get(int(joint))]
        if len(own) > 1 or any(len(joints[actuator]) > 1 for actuator in own):
            source.refuse(
                f"{source.words('joint', int(joint))}, whose uneven actuatorfrcrange bounds the sum of several "
                "actuators or one of several joints of a tendon,",
                "let its ends be opposite numbers, or write forcerange on the actuators",
            )
        if not own:
            source.left_out.append(
                f"the uneven actuatorfrcrange of {source.words('joint', int(joint))}, which has no actuator"
            )
        for actuator in own:
            low, high = sorted(m.jnt_actfrcrange[joint] / joints[actuator][int(joint)])
            ranges[actuator] = tuple(float(np.clip(end, low, high)) for end in ranges[actuator])
    return ranges


def _is_off(source: Source, actuator: int) -> bool:
    """Whether the model's options disable an actuator."""
    option, group = source.model.opt, int(source.model.actuator_group[actuator])
    return source.disabled("ACTUATION") or (0 <= group < 31 and bool(option.disableactuator >> group & 1))
