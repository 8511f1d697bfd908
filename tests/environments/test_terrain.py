"""Height fields of terrain: their shapes in closed form, edges that meet, seeds, tiles, and refusals by name."""

import numpy as np
import pytest

import warp_spo as spo
from warp_spo.recursions.contact.ground import by_cell
from warp_spo.scene import terrain

MAKERS = {
    "slope": lambda **more: terrain.slope(**more),
    "waves": lambda **more: terrain.waves(**more),
    "bars": lambda **more: terrain.bars(**more),
    "stairs": lambda **more: terrain.stairs(**more),
    "rough": lambda **more: terrain.rough(**more),
    "boxes": lambda **more: terrain.boxes(**more),
}


def height(field, x, y):
    """Return the height of the grid's point at x, y."""
    i, j = (round((at - start) / field.cell) for at, start in zip((x, y), field.origin, strict=False))
    return field.heights[i, j]


@pytest.mark.parametrize("name", MAKERS)
def test_fields_are_centred_and_have_height_zero_along_their_edges(name):
    field = MAKERS[name](size=(6.0, 4.0), cell=0.1)
    assert isinstance(field, spo.HeightField) and field.heights.shape == (61, 41)
    np.testing.assert_allclose(field.origin[:2], (-3.0, -2.0), atol=1e-12)
    for edge in (field.heights[[0, -1]], field.heights[:, [0, -1]]):
        np.testing.assert_allclose(edge, 0.0, atol=1e-12)
    assert np.ptp(field.heights) > 0.01


def test_a_slope_rises_with_its_angle_to_a_flat_square():
    field = terrain.slope((8.0, 8.0), 0.05, angle=0.4, platform=2.0)
    assert height(field, -1.0, 0.0) == pytest.approx(2.5 * np.tan(0.4))  # 0.5 m of flat edge, then 2.5 m of slope
    assert height(field, 0.0, 0.9) == pytest.approx(2.5 * np.tan(0.4))
    assert height(field, 0.0, -2.5) == pytest.approx(1.0 * np.tan(0.4))
    np.testing.assert_allclose(terrain.slope(angle=-0.4).heights, -terrain.slope(angle=0.4).heights)


def test_waves_are_sines_away_from_the_edges():
    field = terrain.waves((8.0, 8.0), 0.05, amplitude=0.2, length=2.0)
    for x, y in ((0.5, 0.0), (0.3, -1.2)):
        wanted = 0.1 * (np.sin(np.pi * x) + np.sin(np.pi * y))
        assert height(field, x, y) == pytest.approx(wanted, abs=1e-12)


def test_bars_have_their_height_width_and_spacing():
    field = terrain.bars((8.0, 8.0), 0.05, height=0.15, width=0.2, spacing=1.0)
    row = [height(field, 0.05 * k, 0.0) for k in range(70)]
    assert [k for k, h in enumerate(row) if h] == [*range(38, 43), *range(58, 63)]  # 2 and 3 m, five points of each
    assert set(row) == {0.0, 0.15}


def test_stairs_climb_by_whole_risers_one_tread_apart():
    field = terrain.stairs((8.0, 8.0), 0.05, riser=0.1, tread=0.3, platform=2.0)
    levels = [height(field, -3.5 + 0.05 * k, 0.0) for k in range(51)]
    np.testing.assert_allclose(levels, 0.1 * np.floor(np.arange(51) * 0.05 / 0.3 + 1e-9), atol=1e-12)
    assert height(field, 0.0, 0.0) == pytest.approx(0.8)  # floor(2.5 / 0.3) risers


@pytest.mark.parametrize("name", ["rough", "boxes"])
def test_a_seed_gives_the_same_field_again(name):
    first, again, other = (MAKERS[name](seed=seed).heights for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01


def test_rough_ground_is_bilinear_between_its_grains():
    field = terrain.rough((4.0, 4.0), 0.05, amplitude=0.1, grain=0.2, seed=1)
    middle = field.heights[40:45, 40:45]  # from a grain at 2 m to the next
    corners = middle[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert middle[2, 2] == pytest.approx(corners.mean()) and np.abs(field.heights).max() <= 0.1


def test_tiles_meet_and_grow_harder_by_row():
    field, origins = terrain.tiles(3, 8, (6.0, 6.0), 0.1, seed=5)
    assert field.heights.shape == (181, 481) and origins.shape == (3, 8, 3)
    np.testing.assert_allclose(origins[1, 4], (0.0, 3.0, origins[1, 4, 2]), atol=1e-12)
    stairs = origins[:, list(terrain.KINDS).index("stairs up"), 2]
    assert stairs[0] < stairs[1] < stairs[2]
    for x, y, z in origins.reshape(-1, 3):  # nothing within half a metre is above the start
        assert height(field, x, y) <= z
    alone = terrain.stairs((6.0, 6.0), 0.1, 0.02 + 0.18)
    np.testing.assert_array_equal(field.heights[120:181, 240:301], alone.heights)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: terrain.slope((8.0, 8.03), 0.05), "multiples of the cell"),
        (lambda: terrain.slope(angle=2.0), "angle .* is 2; expected -1.5 to 1.5"),
        (lambda: terrain.stairs(platform=9.0), "platform .* is 9"),
        (lambda: terrain.stairs(tread=0.01), "tread"),
        (lambda: terrain.rough(seed=-1), "seed is -1"),
        (lambda: terrain.waves(amplitude=np.nan), "amplitude"),
        (lambda: terrain.tiles(0, 2), "rows is 0"),
        (lambda: terrain.tiles(1, 1, kinds={}), "kinds is empty"),
        (lambda: terrain.tiles(1, 1, kinds={"high": lambda *a: spo.HeightField(np.ones((161, 161)), 0.05)}), "edges"),
        (lambda: terrain.tiles(1, 1, kinds={"small": lambda *a: spo.HeightField(np.ones((3, 3)), 0.05)}), "'small'"),
    ],
)
def test_what_cannot_be_is_refused_by_name(call, words):
    with pytest.raises(ValueError, match=rf"terrain\.\w+: .*{words}"):
        call()


def test_worlds_start_on_tiles():
    """As many worlds on each kind; rows random up to the hardest; places are the tiles' origins."""
    tiles = terrain.tiles(rows=4, columns=3, size=(3.0, 3.0), cell=0.1, seed=1)
    rows, columns, places = tiles.starts(300, hardest=2, seed=5)
    assert (np.bincount(columns) == 100).all() and set(rows.tolist()) == {0, 1, 2}
    np.testing.assert_array_equal(places, tiles.origins[rows, columns])
    np.testing.assert_array_equal(tiles.starts(300, hardest=2, seed=5)[0], rows)
    for bad in (dict(worlds=0), dict(worlds=3, hardest=4), dict(worlds=3, hardest=-1)):
        with pytest.raises(ValueError, match=r"Tiles.starts: (worlds|hardest) is"):
            tiles.starts(**bad)


def test_a_table_has_the_corners_of_each_cell_together(device):
    """For a set of fields, which are not square; again after their heights have changed."""
    rng = np.random.default_rng(0)
    ball = spo.Body(1.0, inertia=np.eye(3))
    ground = spo.HeightField(rng.normal(size=(3, 5, 4)), 0.1)
    scene = spo.Scene(
        [ball], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(0, sphere=((0, 0, 0), 0.1))], ground=ground
    )
    dyn = spo.Dynamics(scene, 2, device, "float64", variable=("ground_heights",))
    heights, parameters = ground.heights, dyn.recursions.parameters
    for _ in range(2):
        table, known = parameters.ground_cells.numpy().reshape(3, 5, 4, 4), by_cell(heights)
        for field, i, j in np.ndindex(3, 4, 3):
            corners = [heights[field, i + di, j + dj] for di in (0, 1) for dj in (0, 1)]
            assert table[field, i, j].tolist() == known[field, i, j].tolist() == corners
        np.testing.assert_array_equal(table, known)
        heights = rng.normal(size=heights.shape)
        dyn.set(ground_heights=heights)


def test_a_stack_holds_its_fields():
    fields = [terrain.rough((3.0, 3.0), 0.1, seed=seed) for seed in range(3)]
    ground = terrain.stack(fields)
    assert ground.count == 3 and ground.cell == fields[0].cell and ground.origin == fields[0].origin
    np.testing.assert_array_equal(ground.heights[2], fields[2].heights)
    with pytest.raises(ValueError, match="2 fields of 2 kinds"):
        terrain.stack([fields[0], terrain.rough((3.0, 4.0), 0.1)])
