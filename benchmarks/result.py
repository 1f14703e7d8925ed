"""What one comparison with a peer found."""

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Result:
    """Two rates of the same work, measured in one process, and the ratio promised.

    Rates are work per second (samples, steps, cases): larger is better.
    """

    name: str
    ours: float
    peer: float
    peer_name: str
    bar: float

    @property
    def ratio(self) -> float:
        """Our rate over the peer's."""
        return self.ours / self.peer

    @property
    def holds(self) -> bool:
        """Whether the ratio reaches the bar."""
        return self.ratio >= self.bar

    def as_row(self) -> dict[str, object]:
        """Return the fields and what follows from them, as written to bench.json."""
        return {**asdict(self), "ratio": self.ratio, "holds": self.holds}
