"""How long to wait before a stream is opened again."""

from __future__ import annotations

import random

_FIRST_S = 1.0
_LONGEST_S = 60.0
_JITTER = 0.2


class Backoff:
    """Doubles from 1 s to 60 s, by up to 20 % more or less so that not all come back at once.

    ``retries`` is how often in a row a stream may be opened again; None is for ever.
    """

    def __init__(self, retries: int | None, seed: int) -> None:
        self._retries = retries
        self._random = random.Random(seed)
        self.failures = 0

    def next_delay_s(self, *, is_refused: bool = False) -> float | None:
        """Note a failure. The seconds to wait, or None if no retry is left.

        A peer that refuses us is asked rarely: cameras lock out who tries often.
        """
        if self._retries is not None and self.failures >= self._retries:
            return None
        doubled = _FIRST_S * 2.0 ** min(self.failures, 10)
        self.failures += 1
        nominal_s = _LONGEST_S if is_refused else min(_LONGEST_S, doubled)
        jittered_s = nominal_s * self._random.uniform(1 - _JITTER, 1 + _JITTER)
        return min(max(jittered_s, _FIRST_S), _LONGEST_S)

    def reset(self) -> None:
        """The stream is well again."""
        self.failures = 0
