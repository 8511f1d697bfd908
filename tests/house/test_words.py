"""Words of the code: one class a name, and none of the private words for which the field has a name of its own."""

import ast
import collections
import functools
import pathlib

import warp_spo
import warp_spo.kernels

PACKAGE = pathlib.Path(warp_spo.__file__).parent
KERNELS = pathlib.Path(warp_spo.kernels.__path__[0])
FILES = sorted(path for path in PACKAGE.rglob("*.py") if "kernels" not in path.relative_to(PACKAGE).parts)
FILES += sorted(KERNELS.glob("*.py"))

WAITING = {"aggregates", "coupled", "pairs", "ties"}
"""Files of ``recursions/contact`` that go, with ``kernels/couple*``, once all pairs are solved in joint space."""

CLASSES = {
    "Carried": "ContactLinkMotion", "Choice": "ShapeSelection", "Chosen": "SelectedContacts",
    "Closing": "ClosureEvaluator", "Course": "TrainingLog", "Crowd": "CullGroup", "Cut": "PathDecomposition",
    "Found": "PointResult", "Gap": "LiveGap", "Group": "SharedDofs", "Helix": "Helical", "Impedance": "JointLaws",
    "Kept": "PassVariables", "Kind": "HingeType, RecordedCalls", "Lift": "GravityCompensation",
    "Numbers": "SharedConstants", "On": "MaterialRule", "OutOfTime": "TimeLimitReached", "Passes": "PassLoop",
    "Piece": "Segment", "Pieces": "Segments", "Placed": "LinkPlacement", "Plugs": "MassMatrixInterface",
    "Ratio": "CouplingConstraint", "Reports": "ObservableArrays", "Round": "DoublingRound, MidpointIteration",
    "Seat": "BodyPlacement", "Secant": "SecantLaw", "SharedText": "SharedCode", "Slide": "Prismatic",
    "Slots": "ContactSlots", "Solid": "ConvexShape", "Spin": "RotorAxis", "Stand": "NeutralPose",
    "Stretches": "PathBlocks", "Team": "WarpSpecializedKernel", "Tied": "ClusterConstraints", "Touch": "PointState",
    "Traced": "SegmentTrace", "Turn": "Revolute, CallOrder", "Way": "MidpointAdjoint", "Work": "SegmentCode",
}  # fmt: skip
NAMES = {
    "PATIENCE": "FREE_PASSES", "RESTS": "POINTS_AT_REST", "SINK": "STATIC_SINK", "STANCE": "BODIES_AT_REST",
    "_by_warps": "assign_to_warps", "_sole_stiffness": "_foot_stiffness", "alike": "shared_code_fraction",
    "bends": "has_bounds", "bent": "bounded_laws", "closes": "is_last", "compensates": "compensates_gravity",
    "differing": "find_differing", "feed": "path_child", "felt": "row_force", "few": "latency_bound",
    "fork": "common_ancestor", "hinge_laws": "build_joint_laws", "hold_up": "compensate", "in_rounds": "uses_midpoint",
    "in_turns": "laws_in_loops", "instead": "substitutes", "last_kick": "final_kick", "leads": "is_leader",
    "limbs": "leaf_segments", "live": "has_candidates", "looks": "culls",
    "looks_at": "computes_shared_entries_with", "middle_kick": "first_kick", "nothing": "lost_pivot",
    "nudged": "perturb", "pushes": "contact_force", "read_ties": "read_equality_constraints",
    "regrouped": "split_inertia", "remembered": "cached_by_scene", "seat": "placement", "seats": "placements",
    "serial": "longest_path_fraction", "set_aside": "spill_registers", "soil": "ground_shape",
    "suits": "is_supported, supports", "through_kick": "backpropagate_kick",
    "tie_rows": "independent_rows", "ties": "constraint_summary", "unlike": "distinct_dof_count",
    "untangent": "from_tangent", "walks": "traversals",
}  # fmt: skip
"""Functions, fields, attributes and constants; a word that the field uses otherwise, such as gather, is not here."""
MODULES = {
    "alike": "shared_constants", "course": "training_log", "crowds": "contact_culling", "embedding": "loop_analysis",
    "given": "arguments", "groups": "shared_dofs", "helix": "helical", "impedance": "joint_laws",
    "kind": "hinge_type", "middle": "velocity_kicks", "neutral": "effective_mass", "pieces": "segments",
    "plugs": "mass_matrix_interface", "remembered": "scene_cache", "replays": "call_replay",
    "rounds": "midpoint_scheme", "samples": "trial_inputs", "saving": "checkpoint", "secants": "secant_laws",
    "sequences": "elementary", "set_aside": "register_spilling", "slide": "prismatic", "spin": "rotor_axis",
    "staged_rows": "shared_rows", "sticks": "segment_convex", "straight": "straight_line", "stretches": "path_blocks",
    "sums": "body_sums", "teams": "warp_specialized", "touches": "narrow_phase", "turn": "revolute",
    "turns": "call_order", "unsettled": "status", "walks": "body_kinematics",
}  # fmt: skip


def waits(path):
    """Return whether a file waits for the redesign of body contact."""
    if path.parent == KERNELS:
        return path.stem.startswith("couple")
    return path.parent == PACKAGE / "recursions" / "contact" and path.stem in WAITING


@functools.cache
def names_defined_in(path):
    """Return the names of classes, functions, fields, attributes and constants of a file, with their lines."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            found.append((node.name, node.lineno))
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.append((node.target.id, node.lineno))
        elif isinstance(node, ast.Attribute):
            found.append((node.attr, node.lineno))
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id.isupper():
            found.append((node.id, node.lineno))
    return found


def test_a_class_name_stands_once():
    places = collections.defaultdict(list)
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path.name)
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert not twice, f"{twice}: a reader who meets the name does not know which one; name each by what it is"


def test_private_words_stay_away():
    """Where the redesign of body contact is awaited, they may stand until then."""
    banned, found = CLASSES | NAMES, []
    for path in FILES:
        if path.stem in MODULES:
            found.append(f"{path.name}: the module is called {MODULES[path.stem]}")
        if not waits(path):
            found += [f"{path.name}:{line} {x}: {banned[x]}" for x, line in names_defined_in(path) if x in banned]
    assert not found, "\n".join(found)


def test_the_ban_sees_what_it_bans(tmp_path):
    """The planted words: a class, a field, an attribute, a constant."""
    file = tmp_path / "planted.py"
    file.write_text("class Piece:\n    seats: int = 0\n\n\ndef walk(x):\n    return x.looks_at\n\n\nSINK = 1.0\n")
    assert {name for name, _ in names_defined_in(file)} >= {"Piece", "seats", "looks_at", "SINK"}
