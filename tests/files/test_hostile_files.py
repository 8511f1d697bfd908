"""Robot files that strangers may send: each is read, or refused by an error that names the file; nothing is fetched."""

import socket
from unittest import mock

import numpy as np
import pytest

import warp_spo as spo

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
    "a torn file": robot(link("a"), link("b"), joint("a", "b"))[:-25],
    "no file at all": "\0\1\2\3" * 100,
}  # fmt: skip


@pytest.fixture(autouse=True)
def offline():
    """A connection is an error: no file makes one."""
    with mock.patch.object(socket.socket, "connect", side_effect=AssertionError("a robot file opened a connection")):
        yield


@pytest.mark.parametrize("name", REFUSED)
def test_is_refused_by_an_error_that_names_the_file(name, tmp_path):
    file = tmp_path / "hostile.urdf"
    file.write_text(REFUSED[name])
    with pytest.raises(ValueError, match=r"hostile\.urdf") as error:
        spo.load(file)
    assert len(str(error.value)) < 2000 and "/etc" not in str(error.value)


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
        spo.load(file, contacts=True)


@pytest.mark.slow
def test_a_chain_of_thousands_of_links_is_read(tmp_path):
    count = 2000
    file = tmp_path / "robot.urdf"
    file.write_text(robot(*map(link, range(count)), *(joint(i, i + 1) for i in range(count - 1))))
    scene = spo.load(file)
    assert scene.dof_count == count - 1 and scene.tree.depth >= count - 2
