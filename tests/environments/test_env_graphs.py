"""Which parts of a step a graph holds, with torch.cuda replaced: the order of parts, and terms that a graph refuses."""

import contextlib

import pytest
import torch

from warp_spo.env.compile.cuda_graphs import Part, Replay


class Device:
    """Stands in for torch.cuda: a graph repeats what is called while it is captured."""

    def __init__(self, monkeypatch):
        self.capturing, self.mode = None, "default"
        monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: Graph())
        monkeypatch.setattr(torch.cuda, "graph", self.capture)
        monkeypatch.setattr(torch.cuda, "synchronize", lambda *_: None)
        monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: self.mode)
        monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", lambda mode: setattr(self, "mode", mode))

    @contextlib.contextmanager
    def capture(self, graph, capture_error_mode):
        self.capturing = graph
        try:
            yield
        finally:
            self.capturing = None

    def work(self, done, name, waits=False, breaks=False):
        """Return a part that notes its name; one that waits raises where torch would."""

        def run():
            if waits and (self.mode == "error" or self.capturing):
                raise RuntimeError("called a synchronizing CUDA operation")
            if breaks and self.capturing:
                raise RuntimeError("operation not permitted when stream is capturing")
            if self.capturing is None:
                done.append(name)
            else:
                self.capturing.steps.append(lambda: done.append(name))

        return run


class Graph:
    def __init__(self):
        self.steps = []

    def replay(self):
        for step in self.steps:
            step()


@pytest.mark.parametrize(("how", "graphs"), [({}, 1), ({"waits": True}, 2), ({"breaks": True}, 2)])
def test_a_term_that_a_graph_refuses_runs_between_graphs(monkeypatch, recwarn, how, graphs):
    device, done = Device(monkeypatch), []
    names = ["physics", "fine", "user's", "judge", "observe"]
    parts = [
        Part(device.work(done, name, **(how if name == "user's" else {})), name if name in ("fine", "user's") else "")
        for name in names
    ]
    replay = Replay(parts, graphs=True)
    for _ in range(4):
        done.clear()
        replay()
        assert done == names
    assert replay.captured == graphs and device.mode == "default"
    told = [str(warning.message) for warning in recwarn]
    assert len(told) == (1 if how else 0) and all("the term user's cannot be part of a CUDA graph" in x for x in told)


def test_an_error_of_the_environment_or_of_a_term_is_not_hidden(monkeypatch):
    device, done = Device(monkeypatch), []
    own = Replay([Part(device.work(done, "physics", breaks=True))], graphs=True)
    own()
    with pytest.raises(RuntimeError, match="capturing"):
        own()

    def wrong():
        raise RuntimeError("shapes do not match")

    with pytest.raises(RuntimeError, match="shapes"):
        Replay([Part(wrong, "wrong")], graphs=True)()
