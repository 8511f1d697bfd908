"""Kernel files with one planted bug: the source with a line changed, loaded beside the original."""

import importlib.util
import pathlib
import sys

import warp_spo.kernels


def mutant(folder, file, old, new):
    """A copy of ``kernels/<file>.py`` in which ``old``, found once, is ``new``; its Warp modules are its own."""
    source = (pathlib.Path(warp_spo.kernels.__path__[0]) / f"{file}.py").read_text()
    assert source.count(old) == 1, f"{file}.py holds {source.count(old)} times: {old}"
    source = source.replace(old, new).replace('f"warp_spo_', 'f"mutant_')
    source = source.replace("from .", "from warp_spo.kernels.")
    path = pathlib.Path(folder) / f"mutant_{file}.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location(f"{path.stem}_{abs(hash(new))}", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # Warp reads the source of a kernel through its module
    spec.loader.exec_module(module)
    return module
