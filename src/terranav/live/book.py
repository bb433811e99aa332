"""The remarks: each said once when it begins and once when it ends."""

from __future__ import annotations

from dataclasses import dataclass, field

from terranav.live.records import Remark

QUIET_S = 10.0  # what came now and then is over when it did not come for so long


@dataclass(slots=True)
class _Standing:
    level: str
    since_s: float
    last_s: float
    lasting: bool
    count: int = 1


@dataclass(slots=True)
class Book:
    """Remarks that stand, and those to be handed out. `now_s` is the engine's own time, which never steps [s]."""

    stamp_us: int = 0
    now_s: float = 0.0
    standing: dict[str, _Standing] = field(default_factory=dict)
    fresh: list[Remark] = field(default_factory=list)

    def say(self, level: str, key: str, text: str) -> None:
        """Say something once, without an end."""
        self.fresh.append(Remark(self.stamp_us, level, key, text))

    def begins(self, level: str, key: str, text: str, *, lasting: bool = True) -> None:
        """Something begins or goes on. What is not lasting ends by itself when it does not come again."""
        known = self.standing.get(key)
        if known is not None:
            known.last_s = self.now_s
            known.count += 1
            return
        self.standing[key] = _Standing(level, self.now_s, self.now_s, lasting)
        self.say(level, key, text)

    def ends(self, key: str, text: str) -> None:
        """It is over, if it was."""
        if self.standing.pop(key, None) is not None:
            self.say("info", key, text)

    def settle(self) -> None:
        """End what came now and then and does not come any more."""
        for key, one in list(self.standing.items()):
            if not one.lasting and self.now_s - one.last_s > QUIET_S:
                lasted = one.last_s - one.since_s
                times = f"it came {one.count} times within {lasted:.0f} s" if one.count > 1 else "it came once"
                self.ends(key, f"{key}: no more; {times}")

    def taken(self) -> list[Remark]:
        """The remarks since the last time."""
        fresh, self.fresh = self.fresh, []
        return fresh
