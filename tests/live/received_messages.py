"""What comes on keys of a session, for tests."""

from __future__ import annotations

from typing import Any

import zenoh


class ReceivedMessages:
    """Everything that comes on some keys, decoded."""

    def __init__(self, session: zenoh.Session, **kinds: Any) -> None:
        self.messages: dict[str, list[Any]] = {key: [] for key in kinds}
        self._subscribers = [
            session.declare_subscriber(key.replace("__", "/"), self._taker(key, kind)) for key, kind in kinds.items()
        ]

    def _taker(self, key: str, kind: Any) -> Any:
        return lambda sample: self.messages[key].append(kind.decode(sample.payload.to_bytes()))

    def __getitem__(self, key: str) -> list[Any]:
        return self.messages[key]
