"""Gradients by the heights of a field: their sums over worlds and points, and torch's against differences."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support.contact_cases import box
from support.contact_steps import FIELDS, H, above
from warp_spo.execution.height_gradients import HeightSums

torch = pytest.importorskip("torch")


def test_heights_add_up(device):
    """Contributions of many worlds to a few cells, against NumPy; twice the same bits."""
    rng, rows, columns = np.random.default_rng(0), 7, 5
    steps = (0, 1, columns, columns + 1)
    for worlds, standing in ((3000, 0.5), (300, 0.2), (1, 1.0), (40, 0.0)):  # some of them stand on the ground
        cells = rng.integers(0, rows - 1, worlds) * columns + rng.integers(0, columns - 1, worlds)
        cells[::2] = 8  # where most of them are
        parts, wanted = rng.normal(size=(worlds, 4)), np.zeros(rows * columns)
        parts[rng.random(worlds) >= standing] = 0.0
        for corner, step_ in enumerate(steps):
            np.add.at(wanted, cells + step_, parts[:, corner])
        given = [wp.array(x, dtype=wp.float64, device=device) for x in (cells, parts)]
        sums, found = HeightSums(worlds, rows * columns, wp.float64, wp.get_device(device)), []
        for array in (sums.carries, sums.last, sums.sums):
            array.fill_(np.nan)
        for _ in range(2):
            out = wp.full(rows * columns, np.nan, dtype=wp.float64, device=device)
            sums.add_up(*given, steps, out)
            found.append(out.numpy())
        np.testing.assert_allclose(found[0], wanted, atol=1e-13 * worlds)
        assert (found[0] == found[1]).all() and (found[0] != 0.0).any() == (standing > 0.0)
    parts[3, 2] = np.nan
    sums.add_up(given[0], wp.array(parts, dtype=wp.float64, device=device), steps, out)
    assert np.flatnonzero(np.isnan(out.numpy())).tolist() == (cells[3] + np.array(steps))[2:3].tolist()


@pytest.mark.slow
def test_points_with_and_without_walls_have_gradients(device):
    """A point that sees slopes has one surface, others have two; their numbers must not be mixed up."""
    contacts = [spo.Contact(0, point=(0.05, 0.0, z), stiffness=1e4, walls=walls, friction=0.0)
                for z, walls in ((0.0, False), (-1e-3, True), (-2e-3, False))]  # fmt: skip
    heights = np.array([[0.0, 0.01], [0.2, 0.2]])
    slide = spo.Hinge("prismatic", -1, 0, axis=(0.6, 0, 0.8))
    scene = spo.Scene([spo.Body(1.0)], [slide], contacts=contacts, ground=spo.HeightField(heights, 0.1))
    dyn = spo.Dynamics(scene, 2, device, "float64", variable=("ground_heights",))
    kind = dict(dtype=torch.float64, device=str(device).replace("cuda:0", "cuda"))
    q, qd = torch.tensor([[0.02], [0.05]], **kind), torch.tensor([[0.1], [-0.2]], **kind)

    def end(heights):
        dyn.set(ground_heights=heights)
        return dyn.step(q, qd, None, H)[1].sum()

    given = torch.tensor(heights, **kind, requires_grad=True)
    end(given).backward()
    assert (given.grad != 0.0).any()
    for at in np.ndindex(2, 2):
        nudge = torch.zeros_like(given)
        nudge[at] = 1e-7
        wanted = (end(given.detach() + nudge) - end(given.detach() - nudge)) / 2e-7
        assert abs(given.grad[at] - wanted) <= 1e-6 * abs(given.grad).max()


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_torch_differentiates_heights(count, device):
    """Cubes against a riser after three steps: by every height that they stand on, of one field and of two."""
    field, rng = FIELDS["stairs"], np.random.default_rng(0)
    heights = field.heights + 1e-3 * rng.normal(size=(count, *field.heights.shape))  # no two corners are equally low
    heights = heights[0] if count == 1 else heights
    scene = box(ground=spo.HeightField(heights, field.cell, field.origin), friction=0.3)
    if count == 2:
        ball = spo.Contact(0, sphere=0.1, walls=False)
        scene = scene.with_contacts([ball, *scene.contacts], scene.ground)
        scene = scene.with_values(ground_field=np.arange(8)[:, None] % 2)
    a = above(scene, 1, 8)
    dyn = spo.Dynamics(scene, 8, device, "float64", variable=("ground_heights",))
    kind = dict(dtype=torch.float64, device=str(device).replace("cuda:0", "cuda"))
    q0, qd0 = (torch.tensor(a[name], **kind) for name in ("q", "qd"))
    weights = torch.tensor(rng.normal(size=(8, 6)), **kind)

    def end(heights):
        dyn.set(ground_heights=heights)
        q, qd = q0, qd0
        for _ in range(3):
            q, qd = dyn.step(q, qd, None, H)
        return (qd * weights).sum()

    given = torch.tensor(heights, **kind, requires_grad=True)
    end(given).backward()
    mine = given.grad.clone()
    given.grad = None
    end(given).backward()
    assert torch.equal(mine, given.grad) and mine.shape == heights.shape
    touched = torch.nonzero(mine).tolist()
    assert len(touched) >= 20
    for at in map(tuple, touched[:: len(touched) // 20]):
        nudge = torch.zeros_like(given)
        nudge[at] = 1e-7
        wanted = (end(given.detach() + nudge) - end(given.detach() - nudge)) / 2e-7
        assert abs(mine[at] - wanted) <= 1e-6 * abs(mine).max()  # 1e-8 measured


def test_all_worlds_share_heights(device):
    scene = box(ground=FIELDS["rough"])
    higher = FIELDS["rough"].heights + 0.1
    with pytest.raises(ValueError, match=r"ground_heights has shape \(2, 30, 20\); expected \(30, 20\), because all"):
        scene.with_values(ground_heights=np.stack([higher, higher]))
    assert (scene.with_values(ground_heights=higher).ground.heights == higher).all()
    dyn = spo.Dynamics(scene, 2, device, variable=("ground_heights",))
    assert dyn.recursions.parameters.value("ground_heights").shape == (1, 30, 20)
    with pytest.raises(ValueError, match="all worlds share it"):
        dyn.set(ground_heights=np.zeros((2, 30, 20)))
    with pytest.raises(ValueError, match="which all worlds share; expected no worlds="):
        dyn.set(ground_heights=higher, worlds=[True, False])
    dyn.set(ground_heights=higher)
    cells = dyn.recursions.parameters.ground_cells.numpy().reshape(30, 20, 4)[:-1, :-1]
    wanted = np.stack([higher[:-1, :-1], higher[:-1, 1:], higher[1:, :-1], higher[1:, 1:]], axis=-1)
    assert np.array_equal(cells, np.float32(wanted))
