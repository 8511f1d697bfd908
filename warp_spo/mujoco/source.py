"""A MuJoCo model with the words for errors: which call reads it, from which file, and the names of its elements."""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Any, NoReturn

import mujoco
import numpy as np

from ..errors import UnsupportedError, quoted
from ..scene.labels import unused_label


class Source:
    """A MuJoCo model that a call reads.

    Args:
        model: the ``mujoco.MjModel``.
        call: name of the call, for errors.
        file: path of the file that the model was compiled from, for errors; "" if there is none.
        missing: geoms that are not the shapes of the file: what each of them is there.

    Attributes:
        model, call, file, missing: as given.
        left_out: what the scene does not hold, in words, for one warning.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        call: str = "from_mujoco",
        file: str = "",
        missing: Mapping[int, str] = types.MappingProxyType({}),
    ):
        self.model, self.call, self.file, self.missing = model, call, file, missing
        self.left_out: list[str] = []
        self._taken: dict[str, set[str]] = {}

    @property
    def title(self) -> str:
        """The call, and the file if there is one, with which a message begins."""
        return f"{self.call}: {self.file!r}" if self.file else self.call

    def name(self, kind: str, index: int) -> str:
        """Return the name of an element, "" if it has none; ``kind`` is "body", "joint", "actuator" and so on."""
        return mujoco.mj_id2name(self.model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), index) or ""

    def label(self, kind: str, index: int, wanted: str) -> str:
        """Return the name of an element, or ``wanted`` if it has none, or another that no element of its kind has.

        Labels that were given before are not given again; an ``index`` of -1 is that of a part that the model has not.
        """
        if kind not in self._taken:
            size = {"body": "nbody", "joint": "njnt", "actuator": "nactuator", "key": "nkey", "equality": "neq"}[kind]
            count = self.count(size) or self.model.nu if kind == "actuator" else self.count(size)
            self._taken[kind] = {self.name(kind, other) for other in range(count)}
        own = self.name(kind, index) if index >= 0 else ""
        return own or unused_label(wanted, self._taken[kind])

    def words(self, kind: str, index: int) -> str:
        """Return an element's kind and name for a message, such as ``joint 'knee'``."""
        name = self.name(kind, index)
        if name:
            return f"{kind} {quoted(name)}"
        if kind in ("joint", "geom", "site"):
            owner = int(getattr(self.model, {"joint": "jnt_bodyid"}.get(kind, f"{kind}_bodyid"))[index])
            return f"{kind} {index} (no name) of {self.words('body', owner)}"
        return f"{kind} {index} (no name)"

    def refuse(self, what: str, way_out: str) -> NoReturn:
        """Raise UnsupportedError that names the call, the file, the element in ``what`` and a way out."""
        raise UnsupportedError(self.call, f"{self.file!r} with {what}" if self.file else what, way_out)

    def field(self, name: str) -> np.ndarray | None:
        """Return an array of the model, None in versions of MuJoCo that do not have it."""
        found = getattr(self.model, name, None)
        return None if found is None else np.array(found)

    def count(self, name: str) -> int:
        """Return a size of the model, 0 in versions of MuJoCo that do not have it."""
        return int(getattr(self.model, name, 0))

    def disabled(self, name: str) -> bool:
        """Whether the model's option flag of that name is off, such as "GRAVITY"."""
        bit: Any = getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
        return bool(self.model.opt.disableflags & int(bit))

    def enabled(self, name: str) -> bool:
        """Whether the model's option flag of that name, which is off by default, is on, such as "OVERRIDE"."""
        bit: Any = getattr(mujoco.mjtEnableBit, f"mjENBL_{name}")
        return bool(self.model.opt.enableflags & int(bit))
