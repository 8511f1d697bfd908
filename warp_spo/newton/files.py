"""Scenes from robot files, read by Newton's importers; what these misread is refused, or put right first."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from xml.etree.ElementTree import ParseError

import newton
import numpy as np

from ..errors import UnsupportedError
from ..scene.scene import Scene
from .model import from_newton, host, names_of
from .robot_files import (
    MISREAD,
    mjcf_gravity,
    mjcf_misread,
    mjcf_source,
    mjcf_tree,
    mjcf_weighs_by_mesh,
    robot_format,
    urdf_source,
)

REPAIR = 1e-5  # relative: an inertia that finalize moved by more was repaired, not rounded

SHIPPED = {
    "humanoid": "nv_humanoid.xml",
    "ant": "nv_ant.xml",
    "quadruped": "quadruped.urdf",
    "cartpole": "cartpole.urdf",
}


def shipped(name: str) -> Path:
    """Path of a robot that comes with Newton: "humanoid", "ant", "quadruped" or "cartpole".

    Raises:
        ValueError: another name.
    """
    if name not in SHIPPED:
        raise ValueError(f"shipped: unknown robot {name!r}; expected one of {', '.join(SHIPPED)}, or load(path)")
    return Path(newton.__file__).parent / "examples" / "assets" / SHIPPED[name]


# -- a model -----------------------------------------------------------------------------------------------------------


def load(path: str | os.PathLike, floating: bool | None = None) -> Scene:
    """The scene of a robot file: URDF (.urdf), MJCF (.xml, .mjcf) or USD (.usd, .usda, .usdc, .usdz).

    Visuals and collision shapes are skipped, so meshes are read only where a body that moves takes its mass from them.

    Args:
        path: the file.
        floating: whether the root body floats (True) or is fixed to the world (False); None: as the format says (URDF:
            fixed, MJCF: as its joints say, USD: floating unless a joint holds it).

    Raises:
        FileNotFoundError: no such file.
        ValueError: a suffix, or contents, that no importer reads.
        ImportError: a package for meshes or USD is missing; names the extra that installs it.
        UnsupportedError, DirectedLoopError: as :func:`from_newton`.
        UnsupportedError: MJCF that Newton 1.8 misreads: in one body a slide after a hinge or joints with different
            ``pos``, a joint's ``ref``, ``shellinertia`` where shapes give the mass, ``settotalmass``.

    Warns:
        UserWarning: Newton replaced a mass or an inertia that no rigid body has; names the bodies.
    """
    file = Path(path)
    importer = robot_format(file)
    try:
        builder = {"urdf": _read_urdf, "mjcf": _read_mjcf, "usd": _read_usd}[importer](file, floating)
    except ParseError as error:
        raise ValueError(f"load: {str(file)!r} is not XML: {error}; expected {importer.upper()}") from None
    except ImportError as error:
        extra = "usd" if importer == "usd" else "meshes"
        reason = "USD" if importer == "usd" else "a body that moves has no <inertial>, and meshes that give its mass"
        raise ImportError(
            f"load: {str(file)!r} needs a package that is missing ({error}) to read {reason}; "
            f"pip install warp_spo[{extra}]"
        ) from error
    return from_newton(_finalize(builder))


def _finalize(builder: newton.ModelBuilder) -> newton.Model:
    """The model on the CPU; a warning that names the bodies replaces Newton's, which counts them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Inertia validation corrected", category=newton.NewtonWarning)
        # from_newton checks the topology itself, and takes joints outside articulations, which USD files have
        model = builder.finalize(device="cpu", skip_validation_joints=True)
    if builder.body_count == 0:
        return model
    before, after = np.array(builder.body_inertia, dtype=np.float64).reshape(-1, 3, 3), host(model, "body_inertia")
    scale = np.maximum(np.abs(before).max(axis=(1, 2)), np.finfo(np.float32).tiny)
    moved = np.abs(after - before).max(axis=(1, 2)) > REPAIR * scale
    moved |= ~np.isclose(builder.body_mass, host(model, "body_mass"), rtol=REPAIR, atol=0.0)
    if moved.any():
        names = names_of([builder.body_label[body] for body in np.flatnonzero(moved)])
        warnings.warn(
            f"load: Newton replaced the mass or inertia of {names}: as written no rigid body has them "
            "(negative, or one principal moment above the sum of the others); correct the file",
            UserWarning,
            stacklevel=3,
        )
    return model


def _read_urdf(file: Path, floating: bool | None) -> newton.ModelBuilder:
    builder = newton.ModelBuilder()
    builder.add_urdf(urdf_source(file, floating), floating=floating)
    return builder


def _read_mjcf(file: Path, floating: bool | None) -> newton.ModelBuilder:
    root = mjcf_tree(file)
    misread = mjcf_misread(root, floating)
    if misread:
        features = [
            f"{feature} ({'class' if '<default>' in feature else 'body'} {names_of(where)})"
            for feature, where in misread.items()
        ]
        ways_out = dict.fromkeys(MISREAD[feature] for feature in misread)
        raise UnsupportedError("load", f"{str(file)!r} with {', '.join(features)}", "; ".join(ways_out))

    source, weighs_by_mesh = mjcf_source(file, root), mjcf_weighs_by_mesh(root)
    if weighs_by_mesh and source != str(file):
        raise UnsupportedError(
            "load",
            f"{str(file)!r} with a default class 'main' beside masses from meshes",
            "remove class='main', which is what the outermost <default> is, or write the <inertial> of each body",
        )

    def import_with(parse_mujoco_options: bool) -> newton.ModelBuilder:
        builder = newton.ModelBuilder()
        builder.add_mjcf(
            source,
            floating=floating,
            parse_visuals=False,
            parse_meshes=weighs_by_mesh,
            parse_mujoco_options=parse_mujoco_options,
        )
        return builder

    try:
        builder = import_with(parse_mujoco_options=True)
    except ValueError as error:
        # gymnasium's solver="pgs" is one of MuJoCo's options that Newton 1.8 cannot read; a scene has no such options
        try:
            builder = import_with(parse_mujoco_options=False)
        except ValueError:
            raise error from None
    gravity = mjcf_gravity(root)  # which Newton 1.8 does not read
    if gravity is not None:
        builder.gravity = gravity
    return builder


def _read_usd(file: Path, floating: bool | None) -> newton.ModelBuilder:
    builder = newton.ModelBuilder()
    builder.add_usd(str(file), floating=floating, load_visual_shapes=False, skip_mesh_approximation=True)
    return builder
