"""Server-sent events, line by line."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any


@dataclass
class EventReader:
    """Collects the lines of a stream into events."""

    #: The id of the last event that had one.
    last_id: str | None = None
    _name: str = ""
    _data: list[str] = field(default_factory=list)

    def line(self, line: str) -> tuple[str, Any] | None:
        """The event that this line ends: its name and its JSON."""
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if name == "event":
            self._name = value
        elif name == "data":
            self._data.append(value)
        elif name == "id":
            self.last_id = value
        elif not line and self._data:
            event = (self._name, json.loads("\n".join(self._data)))
            self._name, self._data = "", []
            return event
        return None
