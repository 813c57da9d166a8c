"""The conditioning inputs of a graph, as the manifest names them."""

from __future__ import annotations

from typing import Any

from .graph import Graph, Tensor


class Inputs:
    """The actions of the predicted steps and the robot's state; None where the model takes none."""

    def __init__(self, graph: Graph, spec: dict[str, Any]) -> None:
        self.actions: Tensor | None = None
        self.state: Tensor | None = None
        #: The states at all frames of the context.
        self.states: Tensor | None = None
        if "action" in spec["conditioning"]:
            about = "planned actions, the first from the last frame on: " + _named(spec["actions"])
            self.actions = graph.input("actions", ["batch", spec["horizon"], len(spec["actions"])], about)
        if "state" in spec["conditioning"] and spec.get("flow", {}).get("depth", False):
            about = "the robot's state at each frame: " + _named(spec["states"])
            self.states = graph.input("states", ["batch", spec["context"], len(spec["states"])], about)
            self.state = self.states[:, -1]
        elif "state" in spec["conditioning"]:
            about = "the robot's state at the last frame: " + _named(spec["states"])
            self.state = graph.input("state", ["batch", len(spec["states"])], about)


def _named(channels: list[dict[str, Any]]) -> str:
    return ", ".join(f"{channel['name']} {channel['unit']}".rstrip() for channel in channels)
