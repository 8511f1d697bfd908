"""Check of SVG pictures: well-formed, opaque, and everything inside the frame."""

import io
import xml.etree.ElementTree as ET

import matplotlib.image
import resvg_py

EMPTY = 2  # width of the frame's edge that must be blank [px]
AROUND = 0.25  # how far outside the frame drawn things are looked for, as a share of the frame's size


def pixels(text, width):
    """Return an SVG's pixels [row, column, RGBA], 0 to 1."""
    png = resvg_py.svg_to_bytes(svg_string=text, width=width)
    return matplotlib.image.imread(io.BytesIO(bytes(png)), format="png")


def assert_is_whole(text):
    """Fail unless ``text`` is XML that draws on an opaque white ground, with nothing at or beyond the frame's edge."""
    root = ET.fromstring(text)
    x, y, wide, tall = map(float, root.get("viewBox").split())
    assert (x, y) == (0.0, 0.0)
    dx, dy = round(AROUND * wide), round(AROUND * tall)
    frame = f'width="{root.get("width")}" height="{root.get("height")}" viewBox="{root.get("viewBox")}"'
    assert frame in text
    sizes = wide + 2 * dx, tall + 2 * dy
    larger = text.replace(frame, f'width="{sizes[0]}" height="{sizes[1]}" viewBox="{-dx} {-dy} {sizes[0]} {sizes[1]}"')
    image = pixels(larger, round(sizes[0]))  # one pixel for one unit
    left, top, right, bottom = dx, dy, dx + int(wide), dy + int(tall)
    inside = image[top:bottom, left:right].copy()
    image[top - 1 : bottom + 2, left - 1 : right + 2] = 0.0
    assert not image[..., 3].any(), "something is drawn outside the frame"
    assert (inside[..., 3] == 1.0).all(), "the ground is not opaque"
    assert (inside[..., :3] < 0.9).any(), "nothing is drawn"
    for edge in (inside[:EMPTY], inside[-EMPTY:], inside[:, :EMPTY], inside[:, -EMPTY:]):
        assert (edge == 1.0).all(), "something is drawn at the edge of the frame"
