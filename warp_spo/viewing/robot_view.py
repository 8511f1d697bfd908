"""A robot in a browser: ``RobotView``, with sliders, what the library makes of it, and a fall onto the ground."""

from __future__ import annotations

import collections
import contextlib
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..dynamics.dynamics import Dynamics
from ..errors import shown
from ..scene.collision_shapes import moving_trees
from ..scene.ground import Plane
from ..scene.scene import Scene
from ..status import Status
from .appearance import Appearance, file_appearance, model_appearance, scene_appearance
from .bent_bodies import BentBodies
from .browser import HOST, PORT, WORLD, BodyLayer, Page
from .curves import CurveChart
from .motion import GROUNDS, Pull, RobotMotion, make_ground
from .overlays import ORANGE, Arrows, Overlays, point_places
from .pose import close, closed_pose, extent, first_pose, floats
from .robot_text import describe_robot
from .sliders import JointSliders

OWN = "of the file"
SUNK = 0.02  # depth below z = 0 from which on a plane is put beneath a fixed robot: a share of its size
FALL = 0.3  # height from which a robot falls [m]


class RobotView:
    """The page of one robot.

    Args:
        scene: the robot. appearance: what its bodies look like. title: of the page. notes: what was left out or warned
            of, in words. host, port: as of ``Page``. own_ground: false where the file has none: a robot whose root is
            fixed then stands on the plane beneath it.

    Attributes:
        page: the ``Page``. q: coordinates that are shown [coordinate]. poses: of the bodies [body, 7].
        sliders: the :class:`JointSliders`. boxes, numbers: checkboxes and numbers by name. buttons: of the motion.
        falls: whether the robot moves by itself. motion: None before it first does.
    """

    def __init__(
        self, scene: Scene, appearance: Appearance, title: str = "robot", notes: Sequence[str] = (), host: str = HOST,
        port: int = PORT, own_ground: bool = True,
    ):  # fmt: skip
        self.title, self.notes = title, [*notes, *appearance.notes]
        loops = "embed" if scene.constraint_summary else "cut"
        still = scene.with_contacts([])
        try:
            self._kinematics = Dynamics(still, 1, "cpu", "float64", loops=loops)
        except ValueError:  # loops that embedding does not take
            self._kinematics = Dynamics(still, 1, "cpu", "float64", loops="multipliers")
        self.q = first_pose(scene)
        if self._kinematics.closed:
            self.q = closed_pose(self._kinematics, self.q)
        self.poses = self._kinematics.body_poses(self.q[None])[0]
        low, high = extent(appearance, self.poses, scene)
        if floats(scene) and not scene.keyframes and np.array_equal(scene.initial_q, scene.neutral_q):
            self.q[2] -= low[2]  # stands on the ground
            self.poses = self._kinematics.body_poses(self.q[None])[0]
            low, high = extent(appearance, self.poses, scene)
        self.size = max(float(np.linalg.norm(high - low)), 0.05)
        ground = scene.ground if scene.ground is not None else Plane()
        if not own_ground:
            beneath = not floats(scene) and low[2] < -SUNK * self.size
            ground = Plane(float(low[2]) if beneath else 0.0)
            if scene.contacts:
                scene = scene.with_contacts(scene.contacts, ground)
                self.notes.append(f"the file has no ground: the robot stands on the plane z = {ground.height:.3g}")
        self.scene = scene
        self.page = Page(title, host, port, self.size)
        self.page.look_from(self.size, 0.5 * (low + high))
        self._home = self.poses[0, :2].copy()
        self.motion: RobotMotion | None = None
        self.falls, self._steps_due, self._time_due = False, 0, 0.0
        self._pull: Pull | None = None
        self._grip: Any = None
        bent = {i for i, body in enumerate(scene.bodies) if body.modes is not None and body.modes.points is not None}
        drawn = [each for each in appearance.drawn if each.body not in bent]  # a straight bone would hide the bent line
        self.layers = {
            "what the file draws": BodyLayer(self.page, "drawn", drawn, clicked=self._click),
            "collision shapes": BodyLayer(self.page, "collision", appearance.collision, opacity=0.5, visible=False),
        }
        self.overlays = Overlays(self.page, scene, self.size)
        self.flexible = BentBodies(self.page, scene)
        self.arrows = Arrows(self.page, "forces", ORANGE, self.size)
        self._ground_name, self._own_ground = OWN, ground
        self.page.show_ground(ground)
        self.boxes: dict[str, Any] = {}
        self._asked: collections.deque[Callable[[], None]] = (
            collections.deque()
        )  # by buttons, which run in other threads
        self.numbers: dict[str, Any] = {}
        self._closed = self.q.copy()  # the last coordinates at which the loops are closed
        self._panel()
        self._draw()

    # -- panel -------------------------------------------------------------------------------------------------------
    def _panel(self) -> None:
        gui = self.page.gui
        tabs = gui.add_tab_group()
        with tabs.add_tab("Joints"):
            keys = ["initial", *self.scene.keyframes]
            self.keys = gui.add_dropdown("pose", keys, initial_value=keys[1] if len(keys) > 1 else keys[0])
            self._key = self.keys.value
            self.sliders = JointSliders(gui, self.scene, self.q)
        with tabs.add_tab("Show"):
            for name, layer in self.layers.items():
                if layer.handles:
                    self.boxes[name] = gui.add_checkbox(name, layer.visible)
            for name in self.overlays.names:
                self.boxes[name] = gui.add_checkbox(name, False)
            if self.flexible.handle is not None:
                self.boxes["bent shapes"] = gui.add_checkbox("bent shapes", True)
            self.boxes["contact forces"] = gui.add_checkbox("contact forces", True)
            self.boxes["follow"] = gui.add_checkbox("follow the robot", len(moving_trees(self.scene)) == 1)
        with tabs.add_tab("Drop it"):
            self.buttons = gui.add_button_group("motion", ("Drop it", "Pause", "Step", "Back"))
            self.ground = gui.add_dropdown("ground", [OWN, *GROUNDS], initial_value=OWN)
            self.numbers["height"] = gui.add_number("height [m]", FALL, min=0.0, step=0.05)
            self.numbers["dt"] = gui.add_number("dt [s]", 2e-3, min=1e-5, max=0.05, step=1e-4)
            self.numbers["passes"] = gui.add_number("passes (0: as a rule)", 0, min=0, max=16, step=1)
            self.numbers["speed"] = gui.add_slider("speed", 0.05, 2.0, 0.05, 1.0)
            self.boxes["hold"] = gui.add_checkbox("drives hold the pose", True)
            self.said = gui.add_markdown("Click a body to get a handle, and drag that with the mouse.")
            self.energy = CurveChart(gui, "energy [J]", ("kinetic", "potential", "sum"))
            self.statuses = CurveChart(gui, "status (0 is OK)", ("status",), height=110)
        with tabs.add_tab("Text"):
            self.text = gui.add_markdown(describe_robot(self.scene, self.notes))
        deeds = {"Drop it": self.drop, "Pause": self.pause, "Step": self.step_once, "Back": self.back}
        self.buttons.on_click(lambda event: self._asked.append(deeds[event.target.value]))

    # -- what the buttons do -------------------------------------------------------------------------------------------
    def drop(self) -> None:
        """Let the robot fall from the pose of the sliders, a floating one from ``height`` [m] above it."""
        self._begin()
        self.falls = True

    def pause(self) -> None:
        """Hold the motion, or go on with it."""
        self.falls = self.motion is not None and not self.falls

    def step_once(self) -> None:
        """Take one step of ``dt``, and hold."""
        if self.motion is None:
            self._begin()
        self.falls, self._steps_due = False, self._steps_due + 1

    def back(self) -> None:
        """Leave the motion; the sliders move the robot again."""
        self.falls, self.motion = False, None
        self.let_go()
        self.q[:] = self.sliders.q
        self._place()

    def pull(self, body: int) -> None:
        """Put a handle at a body's centre of mass, which pulls the body where the mouse drags it."""
        self.let_go()
        self._pull = Pull(self.scene, body, np.zeros(3))
        self._pull.target = self._pull.place(self.poses)
        self._grip = self.page.scene.add_transform_controls(
            f"{WORLD}/grip", scale=0.3 * self.size, disable_rotations=True, depth_test=False,
            position=tuple(map(float, self._pull.target)),
        )  # fmt: skip

        @self._grip.on_update
        def _(event: Any) -> None:
            if event.phase == "end":
                self._asked.append(self.let_go)

    def _click(self, body: int) -> None:
        self._asked.append(lambda: self.pull(body))

    def let_go(self) -> None:
        """Take the handle of :meth:`pull` away."""
        grip, self._grip, self._pull = self._grip, None, None
        if grip is not None:
            grip.remove()

    def _begin(self) -> None:
        name = self.ground.value
        if self.motion is None or name != self._ground_name:
            self._ground_name, scene = name, self.scene
            ground = make_ground(name, self._own_ground)
            if scene.contacts and name != OWN:
                scene = scene.with_contacts(scene.contacts, ground)
            self.said.content = "The time step is compiled, once for this robot and ground ..."
            self.motion = RobotMotion(scene)
            self.page.show_ground(ground)
        q = self.sliders.q.copy()
        if floats(self.scene):
            q[2] += float(self.numbers["height"].value)
        self._settings()
        self.motion.start(q)
        self.energy.clear()
        self.statuses.clear()
        self._time_due = 0.0

    def _settings(self) -> None:
        assert self.motion is not None
        self.motion.dt = float(self.numbers["dt"].value)
        self.motion.passes = int(self.numbers["passes"].value) or None
        self.motion.held = bool(self.boxes["hold"].value)

    # -- frames --------------------------------------------------------------------------------------------------------
    def tick(self, seconds: float = 0.04) -> None:
        """Show the next frame, ``seconds`` after the last one [s]."""
        while self._asked:
            self._asked.popleft()()
        with self.page.frame():
            self._read_boxes()
            if self.motion is None:
                self._pose()
            else:
                self._move(seconds)

    def _read_boxes(self) -> None:
        for name, layer in self.layers.items():
            if name in self.boxes and layer.visible != self.boxes[name].value:
                layer.visible = self.boxes[name].value
                layer.place(self.poses[None])
        for name in self.overlays.names:
            if self.overlays.shown.get(name, False) != self.boxes[name].value:
                self.overlays.show(name, self.boxes[name].value)
        if self.flexible.handle is not None and self.flexible.handle.visible != self.boxes["bent shapes"].value:
            self.flexible.handle.visible = self.boxes["bent shapes"].value
            self.flexible.place(self.q, self.poses)
        self.arrows.visible = self.boxes["contact forces"].value
        if self.ground.value != self._ground_name and self.motion is not None:
            self._begin()

    def _pose(self) -> None:
        if self.keys.value != self._key:
            self._key = self.keys.value
            named = self.scene.keyframes.get(self._key)
            self.sliders.write(self.scene.initial_q if named is None else named.q)
            self.q[:] = self.sliders.q
        elif not self.sliders.read():
            return
        self.q[:] = self.sliders.q
        if self._kinematics.closed:
            found = close(self._kinematics, self.q)
            self.q[:] = self._closed if found is None else found
            self._closed = self.q.copy()
            self.sliders.write(self.q)
        self._place()

    def _move(self, seconds: float) -> None:
        motion = self.motion
        assert motion is not None
        self._settings()
        steps, self._steps_due = self._steps_due, 0
        if self.falls:
            self._time_due += seconds * float(self.numbers["speed"].value)
            steps += int(self._time_due / motion.dt + 1e-9)
            self._time_due -= int(self._time_due / motion.dt + 1e-9) * motion.dt
        if steps == 0:
            return
        if self._pull is not None and self._grip is not None:
            self._pull.target = np.array(self._grip.position, np.float64)
        try:
            motion.advance(steps, self._pull)
        except (ValueError, RuntimeError) as error:
            self.falls, self.said.content = False, f"The step was refused: {shown(str(error))}"
            return
        kinetic, potential = motion.energies()
        self.energy.add(motion.time, (kinetic, potential, kinetic + potential))
        self.statuses.add(motion.time, (float(motion.status),))
        self.said.content = self._words()
        if not np.isfinite(motion.q).all():
            self.falls = False
            return
        self.q[:] = motion.q[0]
        self._place()
        forces = motion.contact_forces
        if len(forces):
            weight = float(self.scene.values["body_mass"][0].sum()) * 9.81 or 1.0
            self.arrows.show(point_places(motion.scene, self.poses), 0.5 * self.size / weight * forces)

    def _words(self) -> str:
        motion = self.motion
        assert motion is not None
        text = [f"{motion.time:.3f} s. Status {motion.status.name}."]
        if motion.status != Status.OK:
            text.append(motion.status.advice)
        return " ".join([*text, *motion.notes])

    def _place(self) -> None:
        self.poses = self._kinematics.body_poses(self.q[None])[0]
        self._draw()

    def _draw(self) -> None:
        if not np.isfinite(self.poses).all():
            return
        for layer in self.layers.values():
            layer.place(self.poses[None])
        self.overlays.place(self.poses)
        self.flexible.place(self.q, self.poses)
        if self.boxes["follow"].value and floats(self.scene) and self.motion is not None:
            self.page.follow(self.poses[0, :2] - self._home)
        elif self.motion is None:
            self.page.follow((0.0, 0.0))

    # -- uses ----------------------------------------------------------------------------------------------------------
    def run(self) -> None:
        """Show frames until Ctrl-C, or until the process is ended."""
        self.page.run(self.tick)

    def as_html(self, seconds: float, interval: float = 0.04) -> str:
        """Return a fall of so many seconds as one page with a time slider, a picture every ``interval`` [s]."""
        self.page.record()
        self.drop()
        self.page.record_frames(self.tick, seconds, interval)
        return self.page.as_html()

    def _ipython_display_(self) -> None:
        """Show the page inline, in Jupyter, and go on with frames beside it."""
        import threading

        from IPython.display import IFrame, display

        display(IFrame(self.page.url, "100%", 520))
        if not getattr(self, "_thread", None):
            self._thread = threading.Thread(target=self.run, daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the server."""
        self.page.close()


def view(robot: Any, host: str = HOST, port: int = PORT, contacts: Any = None, **options: Any) -> RobotView:
    """Return the page of a robot, whose address is its ``page.url``; Jupyter shows it inline, ``run()`` serves it.

    Args:
        robot: a :class:`warp_spo.Scene`, a ``newton.Model``, or the path of a URDF, MJCF or USD file.
        host: address to listen on; others than this machine can steer only if it is not 127.0.0.1. port: the first to
            try; the next free one is taken.
        contacts: of a file or a model: which shapes touch, see :func:`warp_spo.load`. None: those of all bodies touch
            the ground, and each other if more than one tree moves, as a robot and what it handles do. Where a file says
            no ground, it is the plane z = 0.
        options: further arguments of :func:`warp_spo.load`.

    Raises:
        ImportError: viser is missing; the error names the extra ``view``.
        ValueError, FileNotFoundError: the file cannot be read.
    """
    from .browser import load_viser

    load_viser()
    if isinstance(robot, Scene):
        look = scene_appearance(robot)
        return RobotView(robot, look, "scene", host=host, port=port)
    if isinstance(robot, str | Path):
        file = Path(robot)
        scene, notes, has_ground = load_with_notes(file, contacts, options)
        return RobotView(scene, file_appearance(file, scene), file.name, notes, host, port, has_ground)
    from ..newton import from_newton

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        scene = from_newton(robot, contacts="ground" if contacts is None else contacts)
        if contacts is None and len(moving_trees(scene)) > 1:
            scene = from_newton(robot, contacts=True)
    notes = [str(each.message) for each in caught if issubclass(each.category, UserWarning)]
    return RobotView(scene, model_appearance(robot, scene), "model", notes, host, port)


def load_with_notes(file: Path, contacts: Any, options: dict[str, Any]) -> tuple[Scene, list[str], bool]:
    """Return the scene of a file, the warnings of its loader, and whether its ground is one that somebody chose.

    A file without a ground, such as a URDF, gets the plane z = 0, unless ``options`` have another.
    """
    from ..newton import load

    notes, chosen = list[str](), file.suffix.lower() != ".urdf" or "ground" in options

    def read(contacts: Any) -> Scene:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            found = load(file, contacts=contacts, **options)
        notes[:] = [str(each.message) for each in caught if issubclass(each.category, UserWarning)]
        return found

    try:
        scene = read("ground" if contacts is None else contacts)
        if contacts is None and len(moving_trees(scene)) > 1:
            scene = read(True)
    except (ValueError, ImportError) as error:  # of a shape; without contacts the file may do
        refusal = str(error)
        scene = read(None)
        return scene, [*notes, f"no contacts: {refusal}"], chosen
    if scene.ground is None and "ground" not in options:
        chosen, options = False, options | {"ground": Plane()}
        wanted = contacts if contacts is not None else True if len(moving_trees(scene)) > 1 else "ground"
        with contextlib.suppress(ValueError):  # of a shape that touches nothing
            scene = read(wanted)
    return scene, notes, chosen
