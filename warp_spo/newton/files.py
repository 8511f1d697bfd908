"""Scenes from URDF, MJCF and USD files, read by Newton's importers.

Features that an importer reads wrongly are corrected before the import, or raise UnsupportedError.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from xml.etree.ElementTree import ParseError

import newton
import numpy as np

from ..errors import UnsupportedError
from ..scene.scene import Scene
from .model import from_newton
from .robot_files import (
    MISREAD,
    find_misread,
    mjcf_gravity,
    mjcf_needs_meshes,
    mjcf_source,
    mjcf_tree,
    robot_format,
    urdf_source,
)
from .worlds import quote_labels, to_numpy

REPAIR = 1e-5  # relative change of a mass or inertia above which finalize() repaired it; float32 rounds by less

SHIPPED = {
    "humanoid": "nv_humanoid.xml",
    "ant": "nv_ant.xml",
    "quadruped": "quadruped.urdf",
    "cartpole": "cartpole.urdf",
}


def shipped(name: str) -> Path:
    """Return the path of a robot file that comes with Newton: "humanoid", "ant", "quadruped" or "cartpole".

    Raises:
        ValueError: The name is none of these.
    """
    if name not in SHIPPED:
        raise ValueError(
            f"shipped: unknown robot {name!r}; expected one of {', '.join(SHIPPED)}; "
            "call load(path) for a file of your own"
        )
    return Path(newton.__file__).parent / "examples" / "assets" / SHIPPED[name]


def load(path: str | os.PathLike[str], floating: bool | None = None) -> Scene:
    """Return the scene of a robot file: URDF (.urdf), MJCF (.xml, .mjcf) or USD (.usd, .usda, .usdc, .usdz).

    Visual and collision shapes are skipped. A mesh file is read only if a body that can move takes its mass from it.

    Args:
        path: The robot file.
        floating: Whether the root body floats (True) or is fixed to the world (False). None keeps the format's own
            rule: a URDF root is fixed, an MJCF root has the joints that the file gives it, and a USD root floats unless
            a joint fixes it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: No importer reads files with this suffix, or the file's contents.
        ImportError: A package for meshes or USD is missing. The message names the extra that installs it.
        UnsupportedError, DirectedLoopError: As :func:`from_newton`.
        UnsupportedError: The MJCF file uses a feature that Newton 1.8 misreads, such as a slide after a hinge in one
            body, joints of one body with different ``pos``, a joint's ``ref``, ``shellinertia`` where shapes give the
            mass, or ``settotalmass``. The message says what to write instead.

    Warns:
        UserWarning: Newton replaced a mass or an inertia that no rigid body can have. The message names the bodies.
    """
    file = Path(path)
    importer = robot_format(file)
    try:
        builder = {"urdf": _read_urdf, "mjcf": _read_mjcf, "usd": _read_usd}[importer](file, floating)
    except ParseError as error:
        raise ValueError(f"load: {str(file)!r} is not XML: {error}; expected {importer.upper()}") from None
    except ImportError as error:
        extra = "usd" if importer == "usd" else "meshes"
        need = "USD files" if importer == "usd" else "the meshes that give the mass of a body without <inertial>"
        raise ImportError(
            f"load: {str(file)!r} needs a package that is missing ({error}) to read {need}; "
            f"pip install warp_spo[{extra}]"
        ) from error
    return from_newton(_finalize(builder))


def _finalize(builder: newton.ModelBuilder) -> newton.Model:
    """Return the model on the CPU, and name the bodies that were repaired in a warning; Newton's only counts them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Inertia validation corrected", category=newton.NewtonWarning)
        # from_newton checks the topology itself, and it accepts joints outside articulations, which USD files have.
        model = builder.finalize(device="cpu", skip_validation_joints=True)
    if builder.body_count == 0:
        return model
    before, after = np.array(builder.body_inertia, dtype=np.float64).reshape(-1, 3, 3), to_numpy(model, "body_inertia")
    scale = np.maximum(np.abs(before).max(axis=(1, 2)), np.finfo(np.float32).tiny)
    moved = np.abs(after - before).max(axis=(1, 2)) > REPAIR * scale
    moved |= ~np.isclose(builder.body_mass, to_numpy(model, "body_mass"), rtol=REPAIR, atol=0.0)
    if moved.any():
        names = quote_labels([builder.body_label[body] for body in np.flatnonzero(moved)])
        warnings.warn(
            f"load: Newton replaced the mass or inertia of {names}: the file's values are those of no rigid body "
            "(negative, or one principal moment exceeds the sum of the others); correct the file",
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
    misread = find_misread(root, floating)
    if misread:
        features = [
            f"{feature} ({'class' if '<default>' in feature else 'body'} {quote_labels(where)})"
            for feature, where in misread.items()
        ]
        ways_out = dict.fromkeys(MISREAD[feature] for feature in misread)
        raise UnsupportedError("load", f"{str(file)!r} with {', '.join(features)}", "; ".join(ways_out))

    source, needs_meshes = mjcf_source(file, root), mjcf_needs_meshes(root)
    if needs_meshes and source != str(file):
        raise UnsupportedError(
            "load",
            f"{str(file)!r} with a default class 'main' beside masses from meshes",
            "remove class='main', which the outermost <default> has anyway, or write the <inertial> of each body",
        )

    def import_with(parse_mujoco_options: bool) -> newton.ModelBuilder:
        builder = newton.ModelBuilder()
        builder.add_mjcf(
            source,
            floating=floating,
            parse_visuals=False,
            parse_meshes=needs_meshes,
            parse_mujoco_options=parse_mujoco_options,
        )
        return builder

    try:
        builder = import_with(parse_mujoco_options=True)
    except ValueError as error:
        # Newton 1.8 cannot read some of MuJoCo's options, such as gymnasium's solver="pgs"; a scene needs none of them.
        try:
            builder = import_with(parse_mujoco_options=False)
        except ValueError:
            raise error from None
    gravity = mjcf_gravity(root)  # Newton 1.8 does not read it
    if gravity is not None:
        builder.gravity = gravity
    return builder


def _read_usd(file: Path, floating: bool | None) -> newton.ModelBuilder:
    builder = newton.ModelBuilder()
    builder.add_usd(str(file), floating=floating, load_visual_shapes=False, skip_mesh_approximation=True)
    return builder
