"""Loops over the passes of straight-line code: until guesses were right, or as often as an argument says."""

from .elementary import C_TYPE

MOST_PASSES = 32  # limit for the passes of a loop; 25 was the largest count ever measured, see docs/measured_facts.md
PASS = "pass_row"  # counts the passes from zero


def repeat_passes(ahead: str, a_pass: str, last: str, names: tuple[str, str, str], entries: int, T: type) -> str:
    """Return code that runs ``ahead``, ``a_pass`` until the last variable of ``names`` is zero, and then ``last``.

    The variables are arrays of the thread, ``name_row[i]``, and begin as zeros. Their indices are constants, so that
    the compiler keeps them in registers. The threads of a warp wait for the one that needs most passes.
    """
    c, missed = C_TYPE[T], names[-1]
    declared = [f"{c} {name}_row[{entries}] = {{}};" for name in names[:-1]] + [f"{c} {missed}_row[1] = {{}};"]
    body = f"{_number_pass(a_pass, c)}\nif (!({missed}_row[0] > 0)) break;"
    return "\n".join([ahead, *declared, f"for (int turn = 0; turn < {MOST_PASSES}; ++turn) {{\n{body}\n}}", last])


def _number_pass(a_pass: str, c: str) -> str:
    """Return code of a pass with its number, if it reads that."""
    return f"const {c} {PASS}[1] = {{({c})turn}};\n{a_pass}" if PASS in a_pass else a_pass


def repeat_counted_passes(parts: list[str], entries: dict[str, int], T: type) -> str:
    """Return code that runs the first of three ``parts``, the second as often as ``passes`` says, and the third.

    ``entries`` are the sizes of the thread's arrays by name, ``name_row[i]``, which begin as zeros; their indices are
    constants. ``pass_row[0]`` counts the passes from zero.
    """
    c, (begin, a_pass, last) = C_TYPE[T], parts
    declared = [f"{c} {name}_row[{count}] = {{}};" for name, count in entries.items()]
    return "\n".join([*declared, begin, count_team_passes(a_pass, "", c), last])


def repeat_team_passes(a_pass: str, flags: int, warps: int, c: str) -> str:
    """Return code in which a team repeats ``a_pass`` until, in all its worlds, no warp has added to ``missed_row[0]``.

    A settled world is not ``open``: it keeps its values, so that further passes for its neighbours repeat its results.
    The vote of the warps is also the barrier before the next pass. Their flags alternate between two groups of
    ``warps`` entries of SENT, from ``flags`` on, because a warp may write the next flags while another still reads the
    last ones.
    """
    every = " + ".join(f"SENT(now + {warp})" for warp in range(warps))
    return "\n".join(
        [
            "bool open = true;",
            f"{c} missed_row[1] = {{}};",
            f"for (int turn = 0; turn < {MOST_PASSES}; ++turn) {{",
            "missed_row[0] = 0;",
            _number_pass(a_pass, c),
            f"const int now = {flags} + (turn & 1) * {warps};",
            "SENT(now + warp) = missed_row[0];",
            "const int going = __syncthreads_or(missed_row[0] > 0);",
            f"missed_row[0] = {every};",
            "open = missed_row[0] > 0;",
            "if (!going) break;",
            "}",
        ]
    )


def count_team_passes(a_pass: str, barrier: str, c: str) -> str:
    """Return code in which a team, or a thread with the work of one, runs ``a_pass`` as often as ``passes`` says.

    ``pass_row[0]`` counts the passes from zero. Nothing separates them but the barriers in ``a_pass``: a message that
    another warp reads in a stage is written again in an earlier one.
    """
    loop = "for (int turn = 0; turn < (int)passes_row[0]; ++turn) {"
    return "\n".join([loop, f"const {c} {PASS}[1] = {{({c})turn}};", a_pass, "}", barrier])


def run_one_pass(a_pass: str, barrier: str, c: str) -> str:
    """Return code in which a team runs ``a_pass`` once, because no joint law of the scene has to be guessed."""
    return "\n".join(["const bool open = true;", f"const {c} missed_row[1] = {{}};", "{", a_pass, "}", barrier])


def repeat_thread_passes(a_pass: str, c: str) -> str:
    """Return code in which one thread repeats ``a_pass``, the work of a whole team, until its own world has settled."""
    return "\n".join(
        [
            "const bool open = true;",
            f"{c} missed_row[1] = {{}};",
            f"for (int turn = 0; turn < {MOST_PASSES}; ++turn) {{",
            "missed_row[0] = 0;",
            _number_pass(a_pass, c),
            "if (!(missed_row[0] > 0)) break;",
            "}",
        ]
    )
