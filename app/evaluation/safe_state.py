"""Time to safe state and its floor (`floor`), summed up over rows."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import Any, Final

from app.evaluation.counted import binding, of_task
from app.evaluation.metrics import percentile
from app.evaluation.model import Row, Violation

ALL: Final = "all"
PARTS: Final = ("told_s", "stopped_s", "back_s", "floor_stop_s", "declared_stop_s", "floor_back_s")


class Reached:
    """Sums up what the rows of one method say about time to safe state."""

    def __init__(self) -> None:
        """Begin with no rows."""
        self.pairs: dict[str, list[tuple[float, float]]] = defaultdict(list)
        self._parts: dict[str, dict[str, list[float]]] = defaultdict(lambda: {name: [] for name in PARTS})
        self._counts: dict[str, Counter[str]] = defaultdict(Counter)

    def add(self, row: Row) -> None:
        """Take a row; one without a violation that was there, that policy only warns of, or of a task says nothing."""
        if not binding(row) or of_task(row):
            return
        safe, floor = row.get("safe_s"), row.get("floor_s")
        for violation in (str(row["violation"]), ALL):
            counts = self._counts[violation]
            if floor is None:
                counts["prevented"] += 1
            elif safe is None:
                counts["never"] += 1
            else:
                self.pairs[violation].append((float(safe), float(floor)))
                for name in PARTS:
                    if (value := row.get(name)) is not None:
                        self._parts[violation][name].append(float(value))

    def entries(self) -> dict[str, dict[str, Any]]:
        """Return violation, or `all`, → counts; median and 95th percentile of times, floors, ratios and parts."""
        order = [one for one in (*Violation, ALL) if one in self._counts or one in self.pairs]
        return {str(one): self._entry(str(one)) for one in order}

    def _entry(self, violation: str) -> dict[str, Any]:
        pairs, counts = self.pairs.get(violation, []), self._counts[violation]
        made: dict[str, Any] = {
            "prevented": counts["prevented"],
            "never": counts["never"],
            "n": len(pairs),
            "below": sum(safe < floor - 1e-9 for safe, floor in pairs),
        }
        values = {
            "safe_s": [safe for safe, _ in pairs],
            "floor_s": [floor for _, floor in pairs],
            "ratio": [safe / floor for safe, floor in pairs if floor],
            "above_s": [safe - floor for safe, floor in pairs],
            **self._parts[violation],
        }
        for name, found in values.items():
            made[f"{name}_median"] = percentile(found, 0.5) if found else None
            made[f"{name}_p95"] = percentile(found, 0.95) if found else None
        return made
