"""Robot files that strangers may send: each is read, or refused by an error that names the file; nothing is fetched."""

import socket

import numpy as np
import pytest

import warp_spo as spo

pytestmark = [pytest.mark.usefixtures("offline"), pytest.mark.filterwarnings("ignore:load.*left out")]
LINK = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def link(name):
    return f'<link name="{name}">{LINK}</link>'


def joint(parent, child, kind="continuous", more=""):
    return (
        f'<joint name="to {child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="0 0 1"/>{more}</joint>'
    )


def robot(*parts, head=""):
    return f'{head}<robot name="r">{"".join(parts)}</robot>'


BOMB = '<!DOCTYPE robot [<!ENTITY a0 "ha">' + "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9)) + "]>"
OUTSIDE = '<!DOCTYPE robot [<!ENTITY secret SYSTEM "file:///etc/hostname">]>'
REMOTE = '<!DOCTYPE robot SYSTEM "http://203.0.113.1/robot.dtd">'
DEEP = "<a>" * 20_000 + "</a>" * 20_000
REFUSED = {
    "a billion laughs": robot('<link name="&a9;"/>', head=BOMB),
    "an external entity": robot('<link name="&secret;"/>', head=OUTSIDE),
    "a cycle of joints": robot(link("a"), link("b"), joint("a", "b"), joint("b", "a")),
    "a joint of a link with itself": robot(link("a"), joint("a", "a")),
    "a number of a megabyte": robot(link("a"), link("b").replace('"1"', f'"{"9" * 1_000_000}"', 1), joint("a", "b")),
    "an infinite mass": robot(link("a"), link("b").replace('value="1"', 'value="inf"'), joint("a", "b")),
    "a long name of no link": robot(link("a"), joint("x" * 70_000, "a")),
    "a long word for a type": robot(link("a"), link("b"), joint("a", "b", "x" * 70_000)),
    "a long size of a shape that gives a mass": robot(
        link("a"),
        f'<link name="b"><collision><geometry><sphere radius="{"x" * 70_000}"/></geometry></collision></link>',
        joint("a", "b"),
    ),
    "a torn file": robot(link("a"), link("b"), joint("a", "b"))[:-25],
    "no file at all": "\0\1\2\3" * 100,
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_is_refused_by_an_error_that_names_the_file(name, tmp_path):
    file = tmp_path / "hostile.urdf"
    file.write_text(REFUSED[name])
    with pytest.raises(ValueError, match=r"hostile\.urdf") as error:
        spo.load(file)
    assert len(str(error.value)) < 2000 and "/etc" not in str(error.value)


def test_warnings_show_the_ends_of_long_names(tmp_path):
    """Of joints and of shapes that are left out, in both formats."""
    long, limit = "x" * 70_000, '<limit effort="0" velocity="1" lower="-1" upper="1"/>'
    urdf, xml = tmp_path / "robot.urdf", tmp_path / "robot.xml"
    urdf.write_text(robot(link("a"), link(long), joint("a", long, "revolute", limit)))
    xml.write_text(mjcf(limb(), f'<geom name="{long}" type="box" size="1 1 1"/>'))
    for file in (urdf, xml):
        with pytest.warns(UserWarning, match="xxx[.]{3}xxx") as found:
            spo.load(file, contacts="ground" if file is xml else None)
        assert max(len(str(one.message)) for one in found) < 1500


@pytest.mark.parametrize("text", [robot(link("a"), link("b"), joint("a", "b"), head=REMOTE), robot(link("a"), DEEP)])
def test_what_is_not_needed_is_not_looked_at(text, tmp_path):
    """A remote DTD is not fetched; 20,000 levels of unknown elements are left out."""
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    assert spo.load(file).body_count >= 1


def test_texts_of_other_encodings_are_read(tmp_path):
    text, found = robot(link("föö"), link("b"), joint("föö", "b")), []
    for encoding in ("utf-8", "utf-16"):
        file = tmp_path / f"{encoding}.urdf"
        file.write_bytes(f'<?xml version="1.0" encoding="{encoding}"?>{text}'.encode(encoding))
        found.append(spo.load(file))
    assert found[0].body_labels == found[1].body_labels
    np.testing.assert_array_equal(found[0].values["body_inertia"], found[1].values["body_inertia"])


@pytest.mark.parametrize("place", ["../../secret.stl", "http://203.0.113.1/a.stl", "package://../../secret.stl"])
def test_meshes_elsewhere_are_not_fetched(place, tmp_path):
    """A mesh that is needed and lies nowhere is an error that names it; one that nobody needs is not looked for."""
    shape = f'<collision><geometry><mesh filename="{place}"/></geometry></collision></link>'
    file = tmp_path / "robot.urdf"
    file.write_text(robot(link("a"), link("b").replace("</link>", shape), joint("a", "b")))
    assert spo.load(file).body_count >= 1
    with pytest.raises(ValueError, match=r"robot\.urdf"):
        spo.load(file, contacts="ground")


@pytest.mark.slow
def test_a_chain_of_thousands_of_links_is_read(tmp_path):
    count = 2000
    file = tmp_path / "robot.urdf"
    file.write_text(robot(*map(link, range(count)), *(joint(i, i + 1) for i in range(count - 1))))
    scene = spo.load(file)
    assert scene.dof_count == count - 1 and scene.tree.depth >= count - 2


# -- MJCF --------------------------------------------------------------------------------------------------------------
def mjcf(*parts, head="", top=""):
    return f"{head}<mujoco>{top}<worldbody>{''.join(parts)}</worldbody></mujoco>"


def limb(name="a", inner="", pos="0 0 0", mass="1"):
    return f'<body name="{name}" pos="{pos}"><joint name="{name}"/><geom size=".1" mass="{mass}"/>{inner}</body>'


def shaped(file):
    mesh = f'<asset><mesh name="m" file="{file}"/></asset>'
    return mjcf(limb("a", '<body><joint/><geom type="mesh" mesh="m"/></body>'), top=mesh)


def copies(*counts):
    return "".join(f'<replicate count="{count}" offset="1 0 0">' for count in counts), "</replicate>" * len(counts)


EQUALITY = "</worldbody><equality>{}</equality><worldbody>"
HOSTILE = {
    "a billion laughs": mjcf(limb("&a9;"), head=BOMB),
    "an external entity": mjcf(limb("&secret;"), head=OUTSIDE),
    "20,000 levels of unknown elements": mjcf(DEEP),
    "20,000 levels of bodies": mjcf("<body><joint/><geom size='.1'/>" * 20_000 + "</body>" * 20_000),
    "a billion copies": mjcf(limb().join(copies(10**9))),
    "a billion copies by three": mjcf(limb().join(copies(1000, 1000, "1e3"))),
    "a billion parts of a cloth": mjcf('<body name="b"><flexcomp name="f" type="grid" count="1000 1000 1000"/></body>'),
    "a field of 1e12 points": mjcf(limb(), top='<asset><hfield name="h" nrow="1000000" ncol="1000000"/></asset>'),
    "a picture of 1e12 points": mjcf(limb(), top='<asset><texture width="1000000" height="1000000"/></asset>'),
    "two billion keyframes": mjcf(limb(), top='<size nkey="2000000000"/>'),
    "two billion values of users": mjcf(limb(), top='<size nuser_body="2000000000"/>'),
    "a terabyte of memory": mjcf(limb(), top='<size memory="1000000G"/>'),
    "a file that includes itself": mjcf('<include file="hostile.xml"/>', limb()),
    "a file that attaches itself": mjcf(
        limb(), '<attach model="x" body="a" prefix="p"/>', top='<asset><model name="x" file="hostile.xml"/></asset>'
    ),
    "a file of others": mjcf('<include file="../../../../../../../etc/passwd"/>', limb()),
    "a model of others": mjcf(limb(), top='<asset><model name="x" file="/etc/passwd"/></asset>'),
    "a mesh of others": shaped("/etc/passwd"),
    "a device for a mesh": shaped("/dev/zero"),
    "a format for printf": mjcf('<body><joint class="%s%n"/><geom size=".1"/></body>'),
    "a joint tied to itself": mjcf(limb(), EQUALITY.format('<joint joint1="a" joint2="a"/>')),
    "a number of a megabyte": mjcf(limb(mass="9" * 1_000_000)),
    "an infinite mass": mjcf(limb(mass="inf")),
    "a place that is no number": mjcf(limb(pos="nan 0 0")),
    "a size of less than nothing": mjcf(limb(), top='<asset><texture type="2d" width="-inf" height="4"/></asset>'),
    "a torn file": mjcf(limb())[:-25],
    "UTF-16": mjcf(limb("föö"), head='<?xml version="1.0" encoding="utf-16"?>').encode("utf-16"),
    "Latin-1": mjcf(limb("föö"), head='<?xml version="1.0" encoding="latin-1"?>').encode("latin-1"),
    "no file at all": "\0\1\2\3" * 100,
    "nothing": "",
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_mjcf_is_refused_by_an_error_that_names_the_file(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    file, text = tmp_path / "hostile.xml", HOSTILE[name]
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=r"hostile\.xml") as error:
        spo.load(file)
    assert len(str(error.value)) < 2000 and "root:" not in str(error.value)


def test_mjcf_opens_no_connection(tmp_path, monkeypatch):
    """A DTD, an include, a model, a mesh and a texture at a server of this machine: nobody calls there."""
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}/a"
        texts = [
            mjcf(limb(), head=f'<!DOCTYPE mujoco SYSTEM "{url}.dtd">'),
            mjcf(f'<include file="{url}.xml"/>', limb()),
            mjcf(limb(), top=f'<asset><model name="x" file="{url}.xml"/></asset>'),
            mjcf(limb(), top=f'<asset><texture name="x" type="2d" file="{url}.png"/></asset>'),
            shaped(f"{url}.stl"),
        ]
        found = []
        for text in texts:
            (tmp_path / "hostile.xml").write_text(text)
            try:
                found.append(spo.load(tmp_path / "hostile.xml").body_count)
            except ValueError as error:
                found.append("hostile.xml" in str(error))
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()
    assert found == [1, True, True, 1, True]  # a picture is not needed


def test_ties_in_a_circle_are_read(tmp_path):
    ties = '<joint joint1="a" joint2="b"/><joint joint1="b" joint2="a"/>'
    (tmp_path / "robot.xml").write_text(mjcf(limb("a"), limb("b"), EQUALITY.format(ties)))
    assert len(spo.load(tmp_path / "robot.xml").couplings) == 2


@pytest.mark.slow
def test_five_thousand_bodies_of_mjcf_are_read(tmp_path):
    chains = (
        "".join(f'<body name="{i}_{j}"><joint range="-1 1"/><geom size=".1"/>' for j in range(50)) for i in range(100)
    )
    (tmp_path / "robot.xml").write_text(mjcf(*(chain + "</body>" * 50 for chain in chains)))
    assert spo.load(tmp_path / "robot.xml").dof_count == 5000
