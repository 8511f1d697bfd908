"""Thirteen robots of other packages, their meshes taken out, beside MuJoCo: what is right, refused, and left out.

    python -m benchmarks.robots_of_others FOLDER...               # a table; FOLDERs hold unpacked packages
    python -m benchmarks.robots_of_others FOLDER... --json FILE   # and a file of results

The robots are files of the packages playground 0.2.0 and mjlab 1.6.0 (``pip install --no-deps --target FOLDER
playground==0.2.0 mjlab==1.6.0``), which ship hardly any of the meshes that their files name. So :func:`without_meshes`
takes out of a file the geoms that are meshes and all pictures; ``spo.load`` and MuJoCo read the same file that is left.
Errors of mass matrix, ``qfrc_bias``, ``qacc_smooth``, passive forces and forces of actuators are those of
:mod:`benchmarks.mjcf_files`, in float64 at qpos0 and at two random states. The command fails if a robot is missing, is
refused, differs from MuJoCo, or if something that its model has and its scene has not is not named in a warning.
"""

from __future__ import annotations

import json
import sys
import tempfile
import warnings
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

import warp_spo as spo

from .command_line import parser
from .mjcf_files import Agreement

WALKERS, HANDS = "mujoco_playground/_src/locomotion", "mujoco_playground/_src/manipulation"
MJLAB = "mjlab/asset_zoo/robots"
ROBOTS = {
    "T1": f"{WALKERS}/t1/xmls/scene_mjx_feetonly_flat_terrain.xml",
    "H1": f"{WALKERS}/h1/xmls/scene_mjx_feetonly.xml",
    "Spot": f"{WALKERS}/spot/xmls/scene_mjx_feetonly_flat_terrain.xml",
    "OP3": f"{WALKERS}/op3/xmls/scene_mjx_feetonly.xml",
    "Berkeley humanoid": f"{WALKERS}/berkeley_humanoid/xmls/scene_mjx_feetonly_flat_terrain.xml",
    "Apollo": f"{WALKERS}/apollo/xmls/scene_mjx_feetonly_flat_terrain.xml",
    "Go1, feet": f"{WALKERS}/go1/xmls/scene_mjx_feetonly_flat_terrain.xml",
    "Go1, all shapes": f"{WALKERS}/go1/xmls/scene_mjx_fullcollisions_flat_terrain.xml",
    "LEAP hand, cube": f"{HANDS}/leap_hand/xmls/scene_mjx_cube.xml",
    "ALOHA, peg": f"{HANDS}/aloha/xmls/mjx_single_peg_insertion.xml",
    "G1": f"{MJLAB}/unitree_g1/xmls/g1.xml",
    "Go1": f"{MJLAB}/unitree_go1/xmls/go1.xml",
    "YAM": f"{MJLAB}/i2rt_yam/xmls/yam.xml",
}
"""Path of each robot's file, from the folder in which the packages lie."""

LIMIT = 1e-12  # of errors of mass matrix and bias force
ROUNDING = 1e-14  # of an acceleration, times the condition number of the mass matrix


class Stripped(NamedTuple):
    """An MJCF text without meshes and pictures, and how many geoms, other elements and pictures were taken out."""

    text: str
    meshes: int
    followers: int
    pictures: int


def without_meshes(file: Path) -> Stripped:
    """Return an MJCF file without its mesh geoms, what refers to them by name, and pictures of textures.

    The masses of the file must not come from its meshes: a body that loses its mass so is refused by MuJoCo.

    Raises:
        ValueError: MuJoCo refuses the file, or what is left of it.
    """
    spec = mujoco.MjSpec.from_file(str(file))
    geoms = [geom for geom in spec.geoms if geom.meshname or geom.type == mujoco.mjtGeom.mjGEOM_MESH]
    names = {geom.name for geom in geoms if geom.name}
    followers = [pair for pair in spec.pairs if names & {pair.geomname1, pair.geomname2}]
    followers += [sensor for sensor in spec.sensors if names & {sensor.objname, sensor.refname}]
    for element in (*geoms, *followers, *spec.meshes):
        spec.delete(element)
    pictures = [texture for texture in spec.textures if texture.file or any(texture.cubefiles)]
    for texture in pictures:
        texture.file, texture.cubefiles = "", [""] * 6
        texture.builtin, texture.width, texture.height = mujoco.mjtBuiltin.mjBUILTIN_FLAT, 1, 6  # a picture's least
        texture.nchannel = 3
    spec.compile()
    return Stripped(spec.to_xml(), len(geoms), len(followers), len(pictures))


def left_out(file: Path, **options: Any) -> tuple[spo.Scene, list[str]]:
    """Return the scene of a file, and what ``spo.load`` says that it leaves out, thing by thing."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = spo.load(file, **options)
    said = [str(one.message).partition("left out: ")[2] for one in caught if one.category is UserWarning]
    return scene, [thing for words in said for thing in words.split("; ")]


def unsaid(model: mujoco.MjModel, scene: spo.Scene, said: list[str]) -> list[str]:
    """Return what a model has and its scene has not, without that ``said`` names it: counted in MuJoCo's own arrays."""
    words, dofs = "; ".join(said), scene.dof_count
    moving = np.array([model.body_weldid[body] != 0 for body in model.geom_bodyid])
    solid = np.union1d(np.flatnonzero(model.geom_contype | model.geom_conaffinity), [*model.pair_geom1])
    lost = {
        f"{model.ncam} camera(s)": bool(model.ncam),
        f"{model.nsensor} sensor(s)": bool(model.nsensor),
        "mocap": bool(model.nmocap),
        "contacts of ": not scene.contacts and bool(np.any(moving[solid.astype(int)])),
        "actuators": len(scene.actuators) != model.nu,
        "keyframes": len(scene.keyframes) != model.nkey,
        "sites": len(scene.sites) != sum(bool(model.site(i).name) for i in range(model.nsite)),
        "equalities": len(scene.loops) + len(scene.couplings) != int(model.eq_active0.sum()),
        "tendons": bool(model.ntendon) and not scene.couplings and not scene.actuators,
        "dofs": dofs != model.nv,
    }
    for name, theirs in (
        ("joint_armature", model.dof_armature),
        ("joint_friction", model.dof_frictionloss),
        ("joint_damping", model.dof_damping),
    ):
        ours = np.sort(np.abs(scene.values[name][0])) if name in scene.values else np.zeros(model.nv)
        lost[name] = not np.allclose(ours, np.sort(np.array(theirs).reshape(model.nv, -1)[:, 0]))
    return [name for name, is_lost in lost.items() if is_lost and name not in words]


def compare(file: Path) -> dict[str, Any]:
    """Return the row of one robot: sizes, what was taken out, errors beside MuJoCo, what is left out and not said."""
    stripped = without_meshes(file)
    row: dict[str, Any] = {key: value for key, value in stripped._asdict().items() if key != "text"}
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / file.name
        own.write_text(stripped.text)
        model = mujoco.MjModel.from_xml_path(str(own))
        try:
            scene, row["left_out"] = left_out(own)
            row["left_out_with_contacts"] = left_out(own, contacts="ground")[1]
        except ValueError as refusal:
            return row | {"refused": str(refusal).replace(f"{folder}/", "")}
    beside = Agreement(model, scene, granularity="node")
    errors = beside.errors() | {"passive": beside.passive_error()}
    if model.nu:
        ctrl = np.random.default_rng(0).uniform(-1.0, 1.0, (beside.worlds, model.nu))
        errors["actuators' force"] = beside.actuator_error(ctrl)
    row |= {"dofs": scene.dof_count, "bodies": scene.body_count, "actuators": len(scene.actuators)}
    row |= {name: float(f"{error:.2g}") for name, error in errors.items() if name != "poses"}
    return row | {"unsaid": unsaid(model, scene, row["left_out"])}


def fault(row: dict[str, Any] | None) -> str:
    """Return in words what is wrong with a row, "" if nothing is; None is a robot whose file is missing."""
    if row is None:
        return "missing"
    if "refused" in row:
        return f"refused: {row['refused']}"
    if row["unsaid"]:
        return f"left out in silence: {', '.join(row['unsaid'])}"
    forces = (row[name] for name in ("mass", "bias", "passive", "actuators' force") if name in row)
    far = max(forces) > LIMIT or row["acceleration"] > max(LIMIT, ROUNDING * row["condition"])
    return "differs from MuJoCo" if far else ""


def find(folders: Iterable[Path]) -> dict[str, Path | None]:
    """Return the file of each robot in the folders, None where there is none."""
    roots = list(folders)
    return {
        name: next((root / path for root in roots if (root / path).is_file()), None) for name, path in ROBOTS.items()
    }


def table(rows: dict[str, dict[str, Any] | None]) -> str:
    """Return rows as a Markdown table."""
    lines = [
        "| robot | dofs | meshes taken out | mass matrix | bias force | acceleration | condition | |",
        "|---" * 8 + "|",
    ]
    for name, row in rows.items():
        cells = ["" if row is None else f"{row[key]:.0e}" for key in ("mass", "bias", "acceleration", "condition")
                 if row is None or key in row]  # fmt: skip
        sizes = ["", ""] if row is None else [str(row.get("dofs", "")), str(row["meshes"])]
        lines.append("| " + " | ".join([name, *sizes, *(cells or [""] * 4), fault(row)]) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and write the rows if asked; return 1 if something is wrong with a robot."""
    own = parser("robots_of_others", __doc__, device=False, json="a file for the rows")
    own.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    options = own.parse_args(arguments)
    rows = {name: None if file is None else compare(file) for name, file in find(options.folders).items()}
    print(table(rows))
    if options.json:
        versions = {package: metadata.version(package) for package in ("mujoco", "warp-lang", "numpy")}
        packages = {"playground": "0.2.0", "mjlab": "1.6.0"}
        found = {"versions": versions, "packages of the robots": packages, "robots": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return int(any(fault(row) for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
