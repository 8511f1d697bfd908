"""A policy that acts while one looks, in a browser: ``PolicyView``, on any environment."""

from __future__ import annotations

import collections
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..dynamics.dynamics import Dynamics
from ..errors import shown
from ..scene.ground import HeightField, Plane
from .appearance import Appearance, scene_appearance
from .browser import HOST, PORT, BodyLayer, Page
from .curves import Bars, CurveChart, table
from .pose import extent

MOST_SHOWN, FIRST_SHOWN = 1024, 16  # worlds
LATEST = "latest"
LOOKED_FOR = 2.0  # time from one look for new checkpoints to the next [s]
MOST_STEPS = 10  # of a frame
GAP = 1.3  # distance of worlds side by side, over the robot's size


class Checkpoints(NamedTuple):
    """Checkpoints that a page can choose from.

    Attributes:
        names: returns their names, oldest first. load: returns the policy of a name.
    """

    names: Callable[[], Sequence[str]]
    load: Callable[[str], Any]


class PolicyView:
    """The page of an environment in which a policy acts.

    Args:
        env: a ``warp_spo.env.Env``. policy: function from observations to actions. title: of the page.
        appearance: what bodies look like; None: bones and contact shapes of the scene.
        checkpoints: to choose from; None: the policy stays. playing: name of the checkpoint that ``policy`` is of.
        host, port: as of ``Page``.

    Attributes:
        page: the ``Page``. sliders: of the commands, by name. boxes, numbers, choices: further widgets by name.
        paused: whether the worlds stand still. offsets: of the worlds' places in the picture [world, 3] [m].
        poses: of the bodies that are shown [world, body, 7]. ended: how often each termination has ended an episode.
    """

    def __init__(
        self, env: Any, policy: Any, title: str = "policy", appearance: Appearance | None = None,
        checkpoints: Checkpoints | None = None, playing: str = "", host: str = HOST, port: int = PORT,
    ):  # fmt: skip
        self.env, self.policy, self.checkpoints, self.playing = env, policy, checkpoints, playing
        self.appearance = scene_appearance(env.scene, env.default_q) if appearance is None else appearance
        self.observed, _ = env.reset()
        poses = self._all_poses()[0]
        low, high = extent(self.appearance, poses, env.scene)
        self.size = max(float(np.linalg.norm(high - low)), 0.05)
        self.page = Page(title, host, port, self.size)
        middle = 0.5 * (low + high) - [*poses[0, :2], 0.0]  # the page follows the first body
        self.page.look_from(self.size * (1.5 if env.num_envs > 1 else 1.0), middle)
        ground = env.scene.ground
        self.page.show_ground(ground if ground is not None else Plane())
        self.is_field = isinstance(ground, HeightField)
        self.paused, self._steps_due, self._time_due, self.steps = False, 0, 0.0, 0
        self._asked: collections.deque[Callable[[], None]] = collections.deque()  # by buttons, in other threads
        self.sliders: dict[str, Any] = {}
        self.boxes: dict[str, Any] = {}
        self.numbers: dict[str, Any] = {}
        self.choices: dict[str, Any] = {}
        self.ended = dict.fromkeys(["time out", *env.termination_names], 0)
        self._layer: BodyLayer | None = None
        self._pushed: Dynamics | None = None
        self._sums = self._reward_sums(0)
        self._looked, self._told = time.perf_counter(), 0.0
        self._panel()
        self._sent = [slider.value for slider in self.sliders.values()]
        self._show_worlds(int(self.numbers["worlds shown"].value))
        self.draw()

    # -- panel -------------------------------------------------------------------------------------------------------
    def _panel(self) -> None:
        gui, env = self.page.gui, self.env
        tabs = gui.add_tab_group()
        with tabs.add_tab("Control"):
            self.buttons = gui.add_button_group("run", ("Pause", "Step", "Reset"))
            self.numbers["speed"] = gui.add_slider("speed", 0.1, 4.0, 0.1, 1.0)
            most = min(env.num_envs, MOST_SHOWN)
            self.numbers["worlds shown"] = gui.add_slider(
                "worlds shown", 1, max(most, 2), 1, min(most, FIRST_SHOWN), disabled=most == 1
            )
            self.numbers["followed"] = gui.add_number("followed world", 0, min=0, max=env.num_envs - 1, step=1)
            self.boxes["follow"] = gui.add_checkbox("follow it", True)
            ranges = env.command_ranges
            if ranges:
                with gui.add_folder("Command"):
                    self.boxes["steer"] = gui.add_checkbox("steer all worlds", False)
                    for name, (low, high) in ranges.items():
                        low, high = (low, high) if low < high else (low - 1.0, high + 1.0)
                        middle = min(max(0.0, low), high)
                        self.sliders[name] = gui.add_slider(name, low, high, (high - low) / 200, middle)
                    self.free_button = gui.add_button("Commands as the task draws them")
                    self.free_button.on_click(lambda _: self._asked.append(self.free))
            with gui.add_folder("Push the followed robot"):
                self.choices["body"] = gui.add_dropdown("body", [shown(x) for x in env.scene.body_labels])
                weight = float(env.scene.values["body_mass"][0].sum())
                self.numbers["impulse"] = gui.add_number("impulse [N s]", round(0.5 * weight, 2), min=0.0, step=0.1)
                self.numbers["direction"] = gui.add_slider("direction [deg]", -180, 180, 5, 90)
                self.push_button = gui.add_button("Push")
            if self.checkpoints is not None:
                self.choices["checkpoint"] = gui.add_dropdown("checkpoint", self._names(), initial_value=self._chosen())
                self._choice = self.choices["checkpoint"].value
            self.said = gui.add_markdown("")
        with tabs.add_tab("Rewards"):
            gui.add_markdown("Terms of the followed world, weighted, a second.")
            self.bars = Bars(gui)
            self.reward = CurveChart(gui, "reward, mean of all worlds", ("reward",))
            names = env.reward_names[:10]
            self.terms = CurveChart(gui, "terms of the followed world", [shown(name) for name in names], 220)
        with tabs.add_tab("Ends"):
            self.ends = gui.add_markdown("")
        deeds = {"Pause": self.pause, "Step": self.step_once, "Reset": self.reset}
        self.buttons.on_click(lambda event: self._asked.append(deeds[event.target.value]))
        self.push_button.on_click(lambda _: self._asked.append(self.push))

    def _names(self) -> list[str]:
        assert self.checkpoints is not None
        names = list(self.checkpoints.names())
        extra = [self.playing] if self.playing and self.playing not in names else []
        return [LATEST, *extra, *reversed(names)]

    def _chosen(self) -> str:
        return self.playing if self.playing in self._names() else LATEST

    # -- what the buttons do -------------------------------------------------------------------------------------------
    def pause(self) -> None:
        """Let the worlds stand still, or go on."""
        self.paused = not self.paused

    def step_once(self) -> None:
        """Take one step of the environment, and hold."""
        self.paused, self._steps_due = True, self._steps_due + 1

    def reset(self) -> None:
        """Start all worlds anew."""
        self.observed, _ = self.env.reset()
        self._sums = self._reward_sums(self.followed)
        self.draw()

    def push(self) -> None:
        """Give the followed robot's chosen body the chosen impulse, horizontally, by a jump of its velocities."""
        scene, world = self.env.scene, self.followed
        if self._pushed is None:
            self._pushed = Dynamics(scene.with_contacts([]).without_loops(), 1, "cpu", "float64")
        angle = math.radians(float(self.numbers["direction"].value))
        body = [shown(x) for x in scene.body_labels].index(self.choices["body"].value)
        impulse = np.zeros((1, scene.body_count, 6))
        impulse[0, body, :2] = float(self.numbers["impulse"].value) * np.array([math.cos(angle), math.sin(angle)])
        q = self.env.q[world].cpu().numpy().astype(np.float64)[None]
        dynamics = self._pushed.forward_dynamics
        gained = (dynamics(q, body_f=impulse) - dynamics(q))[0]  # Mass^-1 J* impulse
        self.env.qd[world] += self.env.qd.new_tensor(gained.tolist())

    def free(self) -> None:
        """Let the task draw the commands again, in all worlds; the sliders show them."""
        self.env.memory("command held").zero_()
        self.boxes["steer"].value = False

    @property
    def followed(self) -> int:
        """The world that is followed, pushed and steered."""
        return min(int(self.numbers["followed"].value), self.env.num_envs - 1)

    # -- frames --------------------------------------------------------------------------------------------------------
    def tick(self, seconds: float = 0.04) -> None:
        """Let the policy act for ``seconds`` [s] of the worlds' time at speed 1, and show where the worlds are then."""
        while self._asked:
            self._asked.popleft()()
        self._choose()
        self._steer()
        steps, self._steps_due = self._steps_due, 0
        if not self.paused:
            self._time_due += seconds * float(self.numbers["speed"].value)
            due = int(self._time_due / self.env.step_dt + 1e-6)
            self._time_due -= due * self.env.step_dt
            steps += min(due, MOST_STEPS)
        for _ in range(steps):
            self._step()
        if int(self.numbers["worlds shown"].value) != len(self.offsets):
            self._show_worlds(int(self.numbers["worlds shown"].value))
        self.draw()

    def _step(self) -> None:
        self.observed, reward, done, extras = self.env.step(self.policy(self.observed))
        self.steps += 1
        ended, now = done.cpu().numpy().astype(bool), self.steps * self.env.step_dt
        if ended.any():
            self.ended["time out"] += int(extras["time_outs"].sum())
            for name in self.env.termination_names:
                found = self.env.memory(f"last end {name}")[:, 0].cpu().numpy()
                self.ended[name] += int((found[ended] > 0.5).sum())
        sums = self._reward_sums(self.followed)
        if not ended[self.followed]:
            terms = (sums - self._sums) / self.env.step_dt
            self.bars.show(dict(zip(map(shown, self.env.reward_names), terms.tolist(), strict=True)))
            self.terms.add(now, terms[:10].tolist())
        self._sums = sums
        self.reward.add(now, (float(reward.mean()),))

    def _reward_sums(self, world: int) -> np.ndarray:
        rows = [self.env.memory(f"sum reward {name}")[world, 0] for name in self.env.reward_names]
        return np.array([float(row) for row in rows])

    def _steer(self) -> None:
        """Write what the commands' sliders say where they have moved, or while all worlds are steered.

        Else they show the command of the followed world.
        """
        if not self.sliders:
            return
        values = [float(slider.value) for slider in self.sliders.values()]
        every = bool(self.boxes["steer"].value)
        if values != self._sent or every:
            asked = self.env.q.new_tensor(values)
            self.env.command[slice(None) if every else self.followed] = asked
            self._sent = values
            return
        drawn = self.env.command[self.followed].cpu().tolist()
        for row, (slider, value) in enumerate(zip(self.sliders.values(), drawn, strict=True)):
            shown_value = min(max(value, slider.min), slider.max)
            if abs(shown_value - values[row]) > slider.step:
                slider.value = self._sent[row] = shown_value

    def _choose(self) -> None:
        """Load the checkpoint that is chosen, the newest one of its folder for "latest"."""
        if self.checkpoints is None:
            return
        box, now = self.choices["checkpoint"], time.perf_counter()
        if now - self._looked > LOOKED_FOR:
            self._looked, names = now, self._names()
            if tuple(names) != tuple(box.options):
                chosen = box.value
                box.options = names
                box.value = chosen if chosen in names else LATEST
        chosen = box.value
        names = [name for name in box.options if name != LATEST]
        wanted = (names[0] if names else self.playing) if chosen == LATEST else chosen
        if wanted == self.playing or (chosen == self._choice and chosen != LATEST):
            return
        try:
            self.policy, self.playing = self.checkpoints.load(wanted), wanted
        except (ValueError, OSError, RuntimeError) as error:
            self.said.content = f"{shown(wanted)}: {shown(str(error))}"
        self._choice = chosen

    def _all_poses(self) -> np.ndarray:
        return self.env.dyn.body_poses(self.env.q).cpu().numpy()

    def _show_worlds(self, count: int) -> None:
        if self._layer is not None:
            self._layer.remove()
        count = min(count, self.env.num_envs)
        columns = math.ceil(math.sqrt(count))
        rows = np.arange(count)
        apart = 0.0 if self.is_field else GAP * self.size
        self.offsets = np.stack([-(rows % columns), rows // columns, np.zeros(count)], axis=1) * apart
        self._layer = BodyLayer(self.page, "worlds", self.appearance.drawn, count)

    def draw(self) -> None:
        """Show the worlds where they are now."""
        if not self.page.is_watched and self.steps:
            self._tell()
            return
        count = len(self.offsets)
        every = self._all_poses()
        self.poses = every[:count]
        followed = self.followed
        with self.page.frame():
            assert self._layer is not None
            self._layer.place(self.poses, self.offsets)
            if self.boxes["follow"].value:
                place = self.offsets[followed] if followed < count else 0.0
                self.page.follow(every[followed, 0, :3] + place)
        self._tell()

    def _tell(self) -> None:
        now = time.perf_counter()
        if now - self._told < 0.5:
            return
        self._told = now
        command = ""
        if self.sliders:
            asked = self.env.command[self.followed].cpu().numpy().tolist()
            command = f" Asked: {', '.join(f'{x:.2f}' for x in asked)}."
        playing = f" {shown(self.playing)}." if self.playing else ""
        state = "Paused." if self.paused else ""
        self.said.content = f"{self.steps * self.env.step_dt:.2f} s. {state}{playing}{command}"
        faults = {k: float(v) for k, v in self.env.log().items() if k.startswith(("/not finite", "/beyond"))}
        rows = [(shown(name), count) for name, count in self.ended.items()]
        rows += [(shown(name[1:]), int(count)) for name, count in faults.items() if count]
        self.ends.content = table(("why episodes have ended", "times"), rows)

    # -- uses ----------------------------------------------------------------------------------------------------------
    def run(self) -> None:
        """Let the policy act until Ctrl-C."""
        self.page.run(self.tick, max(self.env.step_dt, 0.02))

    def as_html(self, seconds: float, interval: float = 0.04) -> str:
        """Return so many seconds as one page with a time slider, a picture every ``interval`` [s]."""
        self.page.record()
        self.draw()
        self.page.record_frames(self.tick, seconds, interval)
        return self.page.as_html()

    def close(self) -> None:
        """End the server."""
        self.page.close()
