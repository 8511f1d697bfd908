"""Every robot file at hand: the scene that ``spo.load`` makes of it beside another reader's model of the same file.

    python -m benchmarks.robot_files                   # tables of all formats
    python -m benchmarks.robot_files urdf 'talos'      # files of one format whose path matches an expression
    python -m benchmarks.robot_files --write           # puts the tables into docs/robot_files.md

Each error is the largest difference at a random state, as a share of the largest entry. Of a URDF, mass matrix, bias
force and forward dynamics come from the dense float64 reference, so nothing compiles; of an MJCF, from ``Dynamics``.
"""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import warp_spo as spo
from warp_spo.reference.dense import Dense

PAGE = Path(__file__).parent.parent / "docs" / "robot_files.md"
STATES = 1


class Row(NamedTuple):
    """The comparison of one file. An error is NaN where it means nothing; ``note`` says why. ``limit`` is the bound."""

    file: str
    dofs: int = 0
    mass_matrix: float = np.nan
    bias_force: float = np.nan
    acceleration: float = np.nan
    condition: float = np.nan
    note: str = ""
    limit: float = 1e-9

    @property
    def agrees(self) -> bool:
        """Whether all errors are below the limit, that of the acceleration as far as the condition number allows."""
        allowed = max(self.limit, 1e-14 * self.condition) if np.isfinite(self.condition) else np.inf
        return max(self.mass_matrix, self.bias_force) < self.limit and not self.acceleration > allowed


def short(file: Path) -> str:
    """Return a file's name behind the folder that tells it from others of that name."""
    return f"{file.parts[-3]}/{file.name}"


def error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the largest difference as a share of the largest entry."""
    scale = np.abs(theirs).max(initial=0.0)
    return float(np.abs(ours - theirs).max(initial=0.0) / scale) if scale else float(np.abs(ours).max(initial=0.0))


def random_states(scene: Any, seed: int = 3) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield random q, qd and tau of a scene, quaternions normalised."""
    rng = np.random.default_rng(seed)
    for _ in range(STATES):
        q = rng.uniform(-1.5, 1.5, scene.coord_count)
        for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
            for first in hinge.quaternions:
                turn = slice(start + first, start + first + 4)
                q[turn] /= np.linalg.norm(q[turn])
        yield q, rng.normal(size=scene.dof_count), rng.normal(size=scene.dof_count)


# -- URDF --------------------------------------------------------------------------------------------------------------
class PinocchioFile:
    """Pinocchio's model of a URDF, in the coordinates of the scene that ``spo.load(file, floating=True)`` makes of it.

    Joints are found by name. Mimics are ignored on both sides.
    """

    def __init__(self, scene: Any, text: str):
        import pinocchio

        self.pin, self.scene = pinocchio, scene
        self.model = pinocchio.buildModelFromXML(text, pinocchio.JointModelFreeFlyer())
        self.data = self.model.createData()
        self.com = scene.values["body_com"][0, 0]
        self.joints: dict[int, Any] = {}
        self.order = np.arange(scene.dof_count)  # of the scene's dofs: entry of Pinocchio's velocity
        for h, hinge in enumerate(scene.hinges[1:], 1):
            if hinge.dof_count:
                label = hinge.label.partition("/")[2] if "/" in hinge.label else hinge.label
                index = self.model.getJointId(label)
                if index == self.model.njoints:
                    raise ValueError(f"Pinocchio has no joint {label!r}")
                joint = self.joints[h] = self.model.joints[index]
                if joint.nv != hinge.dof_count:
                    raise ValueError(f"joint {label!r} has {hinge.dof_count} dofs, {joint.nv} in Pinocchio")
                self.order[scene.qd_start[h] : scene.qd_start[h + 1]] = np.arange(joint.idx_v, joint.idx_v + joint.nv)
        if self.model.nv != scene.dof_count:
            raise ValueError(f"{scene.dof_count} dofs, {self.model.nv} in Pinocchio")

    def set(self, q: np.ndarray, qd: np.ndarray) -> None:
        """Compute the maps of a state: Pinocchio's velocity is ``T qd``, its acceleration ``T qdd + rate``."""
        self.q = np.empty(self.model.nq)
        self.q[:7] = q[:7]
        for h, joint in self.joints.items():
            mine = q[self.scene.q_start[h] : self.scene.q_start[h + 1]]
            self.q[joint.idx_q : joint.idx_q + joint.nq] = (np.cos(mine[0]), np.sin(mine[0])) if joint.nq == 2 else mine
        R = self.pin.Quaternion(q[6], q[3], q[4], q[5]).toRotationMatrix()
        arm, w = R @ self.com, qd[3:6]
        self.T = np.zeros((self.model.nv, self.model.nv))
        self.T[self.order, np.arange(self.model.nv)] = 1.0
        self.T[:6, :6] = 0.0
        self.T[:3, :3], self.T[:3, 3:6], self.T[3:6, 3:6] = R.T, R.T @ self.pin.skew(arm), R.T
        self.rate = np.zeros(self.model.nv)
        self.rate[:3] = -R.T @ (np.cross(w, np.cross(w, arm)) + np.cross(w, qd[:3] - np.cross(w, arm)))
        self.qd = qd

    def mass_matrix(self) -> np.ndarray:
        upper = np.triu(self.pin.crba(self.model, self.data, self.q))
        return self.T.T @ (upper + np.triu(upper, 1).T) @ self.T

    def bias_force(self) -> np.ndarray:
        return self.T.T @ self.pin.rnea(self.model, self.data, self.q, self.T @ self.qd, self.rate)

    def forward_dynamics(self, tau: np.ndarray) -> np.ndarray:
        force = np.linalg.solve(self.T.T, tau)
        return np.linalg.solve(self.T, self.pin.aba(self.model, self.data, self.q, self.T @ self.qd, force) - self.rate)


def compare_urdf(file: Path, text: str | None = None) -> Row:
    """Return the errors of a URDF's scene beside Pinocchio's model of it; ``text`` is the file's where it is known.

    The root floats, so that its inertia counts. Inertias are the file's (``repair=False``).
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            scene = spo.load(file, floating=True, repair=False)
        except ValueError as refusal:
            return Row(short(file), note=f"refused: {str(refusal).replace(str(file), file.name)}")
        spo.load(file, floating=True)
    row = Row(
        short(file), scene.dof_count, note=_count_warnings(list(dict.fromkeys(str(one.message) for one in caught)))
    )
    theirs = PinocchioFile(scene, text or file.read_text())
    errors = []
    for q, qd, tau in random_states(scene):
        dense = Dense(scene, q, qd)
        theirs.set(q, qd)
        mass = theirs.mass_matrix()
        condition = np.linalg.cond(mass)
        one = [error(dense.mass_matrix, mass), error(dense.bias_force(), theirs.bias_force()), 0.0, condition]
        if condition < 1e15:
            one[2] = error(dense.forward_dynamics(qd, tau), theirs.forward_dynamics(tau))
        errors.append(one)
    mass_error, bias_error, acceleration_error, condition = (float(worst) for worst in np.max(errors, axis=0))
    if condition >= 1e15:
        acceleration_error = np.nan
        row = row._replace(note=f"{row.note}; the mass matrix is singular".removeprefix("; "))
    return row._replace(
        mass_matrix=mass_error,
        bias_force=bias_error,
        acceleration=acceleration_error,
        condition=condition,
    )


SAID = {
    r"replaced the mass or inertia of (.*?): the file's": "inertias replaced unless `repair=False`",
    r"links (.*?) move and have no mass": "links weighed by their shapes unless `repair=False`",
    r"joint '[^']*' mimics ('[^']*'), which is no joint": "mimics of no joint",
}
"""Meaning of a warning of ``spo.load``, by a pattern whose group holds the names in it."""


def _count_warnings(said: list[str]) -> str:
    """Return the warnings of ``spo.load`` in a few words, with the number of names that they are about."""
    notes = []
    for pattern, meaning in SAID.items():
        count = 0
        for names in re.findall(pattern, "\n".join(said)):
            more = re.search(r"and (\d+) more", names)
            count += len(re.findall(r"'[^']*'", names)) + (int(more.group(1)) if more else 0)
        notes += [f"{meaning}: {count}"] * (count > 0)
    return "; ".join(notes)


def urdf_files() -> list[Path]:
    """Return the URDFs of example-robot-data, of Newton and of MuJoCo, as far as they are installed."""
    import newton

    folders = [Path(newton.__file__).parent]
    for package in ("example-robot-data", "mujoco-core"):
        try:
            folders += {Path(str(file.locate())) for file in metadata.files(package) or () if file.suffix == ".urdf"}
        except metadata.PackageNotFoundError:
            continue
    return sorted(file for found in folders for file in ([found] if found.is_file() else found.rglob("*.urdf")))


def urdf_rows(pattern: str = "") -> Iterator[Row]:
    """Yield a row for each URDF whose path matches an expression, beside Pinocchio's own parser."""
    yield from (compare_urdf(file) for file in urdf_files() if re.search(pattern, str(file)))


# -- MJCF --------------------------------------------------------------------------------------------------------------
def mjcf_files() -> list[tuple[str, Path]]:
    """Return (path from the package on, path) of the MJCFs of newton, mujoco and mujoco_warp; none is imported."""
    found = []
    for package in ("newton", "mujoco", "mujoco_warp"):
        spec = find_spec(package)
        for folder in map(Path, [] if spec is None else spec.submodule_search_locations or []):
            found += [(str(file.relative_to(folder.parent)), file) for file in folder.rglob("*.xml")]
    return sorted(found)


def compare_mjcf(name: str, file: Path) -> Row:
    """Return the errors of an MJCF's scene beside MuJoCo; see :mod:`benchmarks.mjcf_files`."""
    from warp_spo.mujoco.mjcf import compiled

    from .mjcf_files import Agreement

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of contacts and the like
        try:
            scene = spo.load(file)
        except ValueError as refusal:
            words = re.sub(r"^load: ('\S*'(:| with) )?", "", str(refusal)).replace(f"{file.parent}/", "")
            return Row(name, note=f"refused: {words.replace('<', '&lt;')}")
        errors = Agreement(compiled(file)[0], scene, granularity="node").errors()
    keys = ("mass", "bias", "acceleration", "condition")
    return Row(name, scene.dof_count, *(errors[key] for key in keys), limit=1e-12)


def mjcf_rows(pattern: str = "") -> Iterator[Row]:
    """Yield a row for each MJCF whose path matches an expression, beside MuJoCo."""
    yield from (compare_mjcf(name, file) for name, file in mjcf_files() if re.search(pattern, str(file)))


# -- USD ---------------------------------------------------------------------------------------------------------------
class UsdRow(NamedTuple):
    """The comparison of one USD: the largest relative errors of the numbers that the file writes for its bodies."""

    file: str
    bodies: int = 0
    dofs: int = 0
    masses: float = np.nan
    moments: float = np.nan
    centers_of_mass: float = np.nan
    note: str = ""

    @property
    def agrees(self) -> bool:
        """Whether all errors are those of the float32 in which a USD and Newton's importer hold numbers."""
        return not max(self.masses, self.moments, self.centers_of_mass, key=lambda x: -1.0 if np.isnan(x) else x) > 1e-6


def compare_usd(file: Path) -> UsdRow:
    """Return the errors of a USD's scene beside the masses, moments and centres that the file writes."""
    from pxr import Usd, UsdGeom, UsdPhysics

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scene = spo.load(file, repair=False)
        except ValueError as refusal:
            return UsdRow(short(file), note=f"refused: {str(refusal).replace(str(file), file.name)}")
    stage = Usd.Stage.Open(str(file))
    metre, kilogram = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    errors: dict[str, list[float]] = {"masses": [], "moments": [], "centers_of_mass": []}
    for body, label in enumerate(scene.body_labels):
        mass = UsdPhysics.MassAPI(stage.GetPrimAtPath(label))
        value = mass.GetMassAttr().Get()
        if value:
            errors["masses"].append(error(scene.values["body_mass"][0, body], np.array(kilogram * value)))
        moments = np.array(mass.GetDiagonalInertiaAttr().Get() or (0.0, 0.0, 0.0))
        if value and moments.any():
            ours = np.linalg.eigvalsh(scene.values["body_inertia"][0, body])
            errors["moments"].append(error(ours, kilogram * metre**2 * np.sort(moments)))
        center = np.array(mass.GetCenterOfMassAttr().Get() or (-np.inf,) * 3)
        if np.isfinite(center).all():
            scale = np.array(UsdGeom.Xformable(mass.GetPrim()).ComputeLocalToWorldTransform(0)).T[:3, :3]
            center = metre * np.linalg.norm(scale, axis=0) * center
            errors["centers_of_mass"].append(error(scene.values["body_com"][0, body], center))
    return UsdRow(
        short(file),
        scene.body_count,
        scene.dof_count,
        **{name: max(found) for name, found in errors.items() if found},
        note="" if any(errors.values()) else "the file writes none of these",
    )


def usd_files() -> list[Path]:
    """Return the USD files of Newton."""
    import newton

    return sorted(Path(newton.__file__).parent.rglob("*.usd*"))


def usd_rows(pattern: str = "") -> Iterator[UsdRow]:
    """Yield a row for each USD of Newton that has rigid bodies and whose path matches an expression."""
    rows = (compare_usd(file) for file in usd_files() if re.search(pattern, str(file)))
    yield from (row for row in rows if "has no rigid bodies" not in row.note)


FORMATS: dict[str, Callable[[str], Iterator[Any]]] = {"urdf": urdf_rows, "mjcf": mjcf_rows, "usd": usd_rows}
"""Rows by format; a format is one line here."""


def table(rows: list[Any]) -> str:
    """Return rows as a Markdown table."""

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return "" if np.isnan(value) else f"{value:.0e}"
        return str(value or "").replace("|", "/").replace("<", "&lt;")

    fields = [name for name in rows[0]._fields if name not in ("file", "limit")]
    names = ["file", *(name.replace("_", " ").replace("note", "") for name in fields)]
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    lines += [f"| `{row.file}` | {' | '.join(cell(getattr(row, name)) for name in fields)} |" for row in rows]
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Print the tables, or write them into the documentation; return 1 if a file is read wrongly."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format", nargs="?", choices=FORMATS, help="all of them by default")
    parser.add_argument("pattern", nargs="?", default="", help="a regular expression for the path")
    parser.add_argument("--write", action="store_true", help=f"put the tables into {PAGE.name}")
    options = parser.parse_args(arguments)
    wrong = []
    for name in [options.format] if options.format else FORMATS:
        rows = list(FORMATS[name](options.pattern))
        wrong += [row.file for row in rows if not row.agrees and not row.note.startswith("refused")]
        if options.write:
            begin, end = f"<!-- table {name} -->\n", f"<!-- end {name} -->"
            before, _, rest = PAGE.read_text().partition(begin)
            _, found, after = rest.partition(end)
            if not found:
                parser.error(f"{PAGE} has no place for the table; expected the lines {begin.strip()} and {end}")
            PAGE.write_text(f"{before}{begin}{table(rows)}\n{end}{after}")
        else:
            print(f"\n{name}\n\n{table(rows)}")
    if wrong:
        print(f"read wrongly: {', '.join(wrong)}", file=sys.stderr)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
