"""USD files that strangers may send: each is read, or refused by an error that names the file; nothing is fetched."""

import random
import re

import pytest

import warp_spo as spo
from support.usd_texts import HEAD, body, joint, loaded, stage, swing

pytest.importorskip("pxr")
pytest.importorskip("newton_usd_schemas")
pytestmark = [pytest.mark.usefixtures("offline"), pytest.mark.filterwarnings("ignore::newton.NewtonWarning")]

GOOD = swing()


def scene_with(words):
    """A good file whose PhysicsScene says something more."""
    return GOOD.replace("    float physics:gravity", f"    {words}\n    float physics:gravity")


def with_unit(words):
    return GOOD.replace("metersPerUnit = 1", words)


def composed(words):
    """A good file whose arm is composed of something else, too."""
    return GOOD.replace('"arm" (prepend', f'"arm" (prepend {words}\nprepend')


def declared(name):
    """A scene that declares a value of Newton's model."""
    data = 'customData = {\nstring assignment = "model"\nstring frequency = "once"\n}'
    return scene_with(f"custom float newton:{name} = 5 (\n{data}\n)")


NESTED_VARIANTS = 'def "a"\n{\nvariantSet "v" = {\n"x" {\n' * 20_000
MULTIPLIED = "#usda 1.0\n" + "".join(
    f'def "a{level}"\n{{\n'
    + "".join(f'def "b{number}" (references = </a{level + 1}>)\n{{\n}}\n' for number in range(10))
    + "}\n"
    for level in range(9)
)
REFUSED = {
    "a torn file": GOOD[:-40],
    "a file of zeros": "\0" * 400,
    "bytes that are no text": GOOD.encode().replace(b"World", b"W\xff\xfe", 1),
    "UTF-16": GOOD.encode("utf-16"),
    "20,000 levels": "#usda 1.0\n" + 'def "a"\n{\n' * 20_000 + "}\n" * 20_000,
    "20,000 levels of variants": "#usda 1.0\n" + NESTED_VARIANTS + "}\n}\n}\n" * 20_000,
    "a prim that refers to its parent": composed("references = </World>"),
    "a prim that inherits itself": composed("inherits = </World/arm>"),
    "a layer below itself": GOOD.replace("(\n", "(\n    subLayers = [@./robot.usda@]\n", 1),
    "a reference to a URL": composed("references = @http://203.0.113.1/a.usda@</World>"),
    "a payload at a URL": composed("payload = @https://203.0.113.1/a.usd@</World>"),
    "a layer at a URL": GOOD.replace("(\n", "(\n    subLayers = [@http://203.0.113.1/a.usda@]\n", 1),
    "a file that is not USD": composed("references = @../../../../../../etc/passwd@</World>"),
    "a device": composed("references = @/dev/zero@</World>"),
    "a cycle of two joints": stage(body("a"), body("b"), joint("j", "a", "b"), joint("k", "b", "a")),
    "a cycle of joints": stage(*map(body, "abc"), joint("j", "a", "b"), joint("k", "b", "c"), joint("l", "c", "a")),
    "a joint of a body with itself": stage(body("a"), joint("j", "a", "a")),
    "a joint to nothing": stage(body("a"), joint("j", None, "b")),
    "a mass that is no number": swing().replace("mass = 2.0", "mass = nan"),
    "a mass of 1e300": swing().replace("mass = 2.0", "mass = 1e300"),
    "a mass that is a text": swing().replace("float physics:mass = 2.0", 'string physics:mass = "2"'),
    "a value of MuJoCo that is a text": swing('string mjc:armature = "x"'),
    "a value of MuJoCo that is no number": swing("double mjc:armature = nan"),
    "a place that is no number": swing("point3f physics:localPos0 = (0, nan, 0)"),
    "a quaternion of zeros": swing("quatf physics:localRot0 = (0, 0, 0, 0)"),
    "a quaternion of 1e30": swing("quatf physics:localRot0 = (1e30, 1e30, 0, 0)"),
    "an axis W": swing('uniform token physics:axis = "W"'),
    "a number of a megabyte": swing(f"float physics:lowerLimit = {'9' * 1_000_000}"),
    "a body nowhere": swing().replace("xformOp:translate = (0, 0, 0)", "xformOp:translate = (0, inf, 0)"),
    "gravity that is no number": GOOD.replace("Magnitude = 10", "Magnitude = nan"),
    "a unit of zero": with_unit("metersPerUnit = 0"),
    "a unit of 1e300": with_unit("metersPerUnit = 1e300"),
    "a unit that is no number": with_unit("metersPerUnit = nan"),
    "a declaration of gravity": declared("gravity"),
    "a declaration of masses": declared("body_mass"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_is_refused_by_an_error_that_names_the_file(name, tmp_path):
    file, text = tmp_path / "robot.usda", REFUSED[name]
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=f"^load: {re.escape(repr(str(file)))}") as error:
        spo.load(file)
    assert len(str(error.value)) < 1000 and "root:" not in str(error.value) and "\n" not in str(error.value)


def test_files_above_the_folder_are_read_if_they_are_usd(tmp_path):
    """As composition is meant; nothing else is."""
    (tmp_path / "other.usda").write_text(stage(body("hand")))
    folder = tmp_path / "robot"
    folder.mkdir()
    scene, _ = loaded(folder, composed("references = @../other.usda@</World>"))
    assert "/World/arm/hand" in scene.body_labels


def test_prims_that_refer_to_ten_others_level_by_level_are_counted(tmp_path):
    """Not composed: they would be more than a billion. In a file that the first one names, too."""
    with pytest.raises(ValueError, match=r"^load: .*robot\.usda' has more than 1000000 prims"):
        loaded(tmp_path, MULTIPLIED)
    (tmp_path / "many.usda").write_text(MULTIPLIED)
    with pytest.raises(ValueError, match=r"^load: .*robot\.usda' has more than 1000000 prims"):
        loaded(tmp_path, composed("references = @./many.usda@</a0>"))


def test_levels_of_a_file_that_another_names_count(tmp_path):
    (tmp_path / "deep.usda").write_text(REFUSED["20,000 levels of variants"])
    with pytest.raises(ValueError, match=r"robot\.usda.*deep\.usda has 60000 levels"):
        loaded(tmp_path, composed("references = @./deep.usda@</World>"))


def test_what_is_not_needed_is_not_looked_at(tmp_path):
    """A policy of Newton's actuators and a texture at a URL are not opened; braces in texts are no levels."""
    motor = 'def NewtonActuator "m" (prepend apiSchemas = ["NewtonNeuralControlAPI"])\n{{\n{}\n}}\n'.format(
        "rel newton:targets = </World/j>\nasset newton:modelPath = @/etc/passwd@"
    )
    more = 'asset inputs:file = @https://203.0.113.1/a.png@\ncustom string a = """' + "{" * 2000 + '"""'
    scene, warning = loaded(tmp_path, swing(more) + motor)
    assert scene.dof_count == 1 and "NewtonActuators (/m)" in warning


def test_names_are_shown_escaped_and_short(tmp_path):
    name = "a" * 100_000
    _, warning = loaded(tmp_path, swing("float physxJoint:jointFriction = 1").replace('"j"', f'"{name}"'))
    assert "jointFriction" in warning and len(warning) < 500
    _, warning = loaded(tmp_path, GOOD.replace("arm", "föö"))
    assert not warning


@pytest.mark.parametrize("seed", range(3))
def test_torn_and_changed_files_are_read_or_refused(seed, tmp_path):
    """Thirty of each seed: cut, or with some bytes others; texts only, because OpenUSD hangs on some binary ones."""
    rng, good = random.Random(seed), stage(body("a"), body("b"), joint("j", "a", "b", "float mjc:armature = 2"))
    for number in range(30):
        data = bytearray(good.encode())
        if number % 3 == 0:
            del data[rng.randrange(len(data)) :]
        for _ in range(number % 3):
            data[rng.randrange(len(data))] = rng.randrange(256)
        file = tmp_path / f"{number}.usda"
        file.write_bytes(data)
        try:
            spo.load(file)
        except ValueError as error:
            assert str(error).startswith(f"load: {str(file)!r}")


@pytest.mark.slow
def test_a_chain_of_thousands_of_bodies_is_read(tmp_path):
    count = 2000
    joints = [joint(f"j{i}", f"b{i - 1}" if i else None, f"b{i}") for i in range(count)]
    scene, _ = loaded(tmp_path, stage(*(body(f"b{i}") for i in range(count)), *joints))
    assert scene.dof_count == count and scene.tree.depth >= count - 2


def test_joints_in_an_instance(tmp_path):
    """They are read; one that would have to be turned round is refused, because an instance cannot be changed."""
    robot = stage(body("arm"), joint("j", None, "arm"))
    made = robot.replace('def Xform "World"', 'class Xform "World"') + (
        'def Xform "Robot" (instanceable = true\nprepend references = </World>)\n{\n}\n'
    )
    assert loaded(tmp_path, made)[0].dof_count == 1
    with pytest.raises(spo.UnsupportedError, match="in an instance"):
        loaded(tmp_path, made.replace("physics:body1", "physics:body0"))


def test_a_stage_without_a_scene_has_the_usual_gravity(tmp_path):
    text = GOOD.replace(HEAD, HEAD[: HEAD.index("def PhysicsScene")])
    assert loaded(tmp_path, text)[0].values["gravity"][0, 2] == pytest.approx(-9.81)
