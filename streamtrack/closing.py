"""What is closed when its context is left, however that happens."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self

from streamtrack.errors import OutputError


class Closing(ABC):
    """Leaving the context closes; an error then is a note on the one that is under way, if any."""

    @abstractmethod
    def close(self) -> None:
        """Give back or complete what is held; further calls do nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except OutputError as error:
            if exc is None:
                raise
            exc.add_note(str(error))
