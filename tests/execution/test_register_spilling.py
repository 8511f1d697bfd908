"""Statements that set values aside in shared memory compute the same bits."""

import re

import numpy as np
import warp as wp

from support import zoo
from warp_spo.execution.device_facts import MEASURED
from warp_spo.execution.plan import choose
from warp_spo.kernels import native, shared_rows, straight_line
from warp_spo.recursions.forward_dynamics import forward_dynamics_bias_first
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.tracing import Trace
from warp_spo.trace.emission import Emitter, Store, render
from warp_spo.trace.register_spilling import spill_registers

TEXT = """\
if (warp == 0) {
const float x1 = a;
FILL
if (warp == 0) {
const float y1 = b + x1;
FILL
s = y1;
}
FILL
const float x2 = x1 + b;
FILL
s = x2 * x1;
}
else {
const float x1 = b;
float s3, c4;
on::sincos(x1, s3, c4);
FILL
s = x1 + s3;
s = c4;
}""".replace("FILL", "\n".join(["s = s + a;"] * 300))


def simulate(text, values):
    """Run statements of a thread in Python, both branches after each other; return what ``s`` was."""
    seen, names = [], dict(values, warp=0)
    for line in text.split("\n"):
        line = re.sub(r"^const float |;$", "", line)
        line = re.sub(r"ASIDE\((\d+)\)", r"aside_\1", line)
        pair = re.match(r"on::sincos\((.*), (\w+), (\w+)\)", line)
        if pair:
            line = f"{pair[2]}, {pair[3]} = 2 * {pair[1]}, 3 * {pair[1]}"
        if line.startswith(("if", "else", "}", "float")):
            continue
        exec(line, {}, names)
        seen += [names["s"]] if line.startswith("s = ") else []
    return seen


def test_values_of_branches_are_set_aside_in_places_of_their_own():
    few, many = (spill_registers(TEXT, "float", places) for places in (1, 9))
    assert "ASIDE(1)" not in few and "ASIDE(0)" in few
    assert "y1_from" in many and "x1_from" in many and "s3_from" in many and "c4_from" in many
    plain = simulate(TEXT, dict(a=1.0, b=10.0, s=0.0))
    assert plain == simulate(few, dict(a=1.0, b=10.0, s=0.0)) == simulate(many, dict(a=1.0, b=10.0, s=0.0))
    assert "const float y1 = b + x1;" in many, "what an inner scope reads back the outer one does not see"


def test_forward_dynamics_has_the_same_bits(device):
    """Of a tree with 10 dofs, with 4 and with 40 places."""
    scene = zoo.branched(0)
    trace = Trace(Links(scene), "float32", ("q", "qd", "tau"))
    stores = [Store("out", item.index, item.value) for item in forward_dynamics_bias_first(trace)]
    rng = np.random.default_rng(1)
    given = {"q": rng.uniform(-1, 1, (40, scene.coord_count)), "qd": rng.normal(size=(40, scene.dof_count))}
    given |= {"tau": rng.normal(size=(40, scene.dof_count))}
    emitter = Emitter("float32", lambda array, entry: f"{array}_row[{entry}]",
                      lambda array, entry, value: f"if (mine) result_row[{entry}] = {value};",
                      lambda array, index: index[0], fuses=True)  # fmt: skip
    plain = render(emitter.region(stores), "float32")
    rows = [shared_rows.SharedRow(name, 2, array.shape[1]) for name, array in given.items()]
    frame = straight_line.KernelLayout(
        rows=rows,
        staged=False,
        fields=[],
        result=straight_line.ResultLayout(straight_line.DIRECT, rows[1]._replace(name="out")),
        messages=0, warps=1, block=32)  # fmt: skip
    found = []
    for places in (0, 4, 40):
        text = spill_registers(plain, "float", places) if places else plain
        assert (text.count("= ASIDE(") > 4) == bool(places)
        cpu = f"float aside[{places + 1}];\n#define ASIDE(i) aside[i]\n{text}\n#undef ASIDE"
        cuda = straight_line.assemble(frame._replace(spill_slots=places), text, cpu, wp.float32)
        kernel = native.kernel("aside", cuda, [(row.name, 2) for row in rows] + [("out", 2)], wp.float32)
        arrays = [wp.array(array, dtype=wp.float32, device=device) for array in given.values()]
        out = wp.full((40, scene.dof_count), float("nan"), dtype=wp.float32, device=device)
        wp.launch(kernel, 64 if device.is_cuda else 40, [40, *arrays], [out], device=device, block_dim=32)
        found.append(out.numpy())
    assert np.isfinite(found[0]).all()
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])


def test_values_are_set_aside_where_blocks_have_room():
    """Not with few worlds, folded inertias, in float64, by smaller scenes, by other routines or without the memory."""
    from warp_spo.dynamics.forward_dynamics import FORWARD_DYNAMICS

    scene, routine = zoo.branched(6), FORWARD_DYNAMICS.routine
    many = choose(scene, 65536, MEASURED, "float32", variable_inertia=True)
    assert scene.dof_count > 32
    size = 32 * 1024
    places = many.spill_slots(routine, size, 4, 4)
    assert places >= 28 and 3 * (size + 128 * 4 * places + 3 * 1024) <= MEASURED.shared_bytes
    assert choose(scene, 4096, MEASURED, "float32", variable_inertia=True).spill_slots(routine, size, 4, 4) == 0
    assert choose(scene, 65536, MEASURED, "float32").spill_slots(routine, size, 4, 4) == 0
    assert many.spill_slots(routine, 2 * size, 8, 4) == 0
    assert many.spill_slots(routine, 2 * size, 4, 4) == 0
    assert many.spill_slots(routine.hints.bias_first, size, 4, 4) == 0
    assert (
        choose(zoo.branched(3), 65536, MEASURED, "float32", variable_inertia=True).spill_slots(routine, size, 4, 4) == 0
    )
