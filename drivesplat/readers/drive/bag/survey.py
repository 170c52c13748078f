"""A first look at a bag: topics, types, rates, frames and clocks, from a few messages of each topic."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.bag.bag_file import BagFile, frame_name, header_stamp
from drivesplat.readers.drive.bag.clouds import POINT_CLOUD
from drivesplat.readers.drive.bag.images import CAMERA_INFO, COMPRESSED_IMAGE, RAW_IMAGE
from drivesplat.readers.drive.bag.transforms import LATCHED, ODOMETRY, TRANSFORMS

SAMPLES = 3
"""Messages of a topic that are looked at."""
MAX_CLOCK_SPREAD_S = 10.0
"""Seconds by which the stamps of topics may differ from each other by the log times: messages may be recorded late."""
KINDS = (RAW_IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, POINT_CLOUD, ODOMETRY, *TRANSFORMS)


@dataclass(frozen=True, eq=False)
class TopicSurvey:
    """A topic with messages that an import uses: their number per second of the bag, the frame of its first message,
    the median of stamp minus log time in seconds, the usual time between the first stamps, and the first messages."""

    name: str
    kind: str
    count: int
    rate: float
    frame: str
    ahead_s: float | None
    interval_s: float | None
    samples: Sequence[Any]

    @property
    def is_image(self) -> bool:
        return self.kind in (RAW_IMAGE, COMPRESSED_IMAGE)


@dataclass(frozen=True, eq=False)
class BagSurvey:
    """The topics of a bag that an import uses, by name, and the others with their types."""

    topics: dict[str, TopicSurvey]
    others: dict[str, str]
    seconds: float

    def of_kind(self, *kinds: str) -> list[TopicSurvey]:
        return [topic for topic in self.topics.values() if topic.kind in kinds]

    def table(self) -> str:
        """A line for each topic: type, messages, rate, frame, and how far stamps are from log times."""
        rows = [("topic", "type", "messages", "Hz", "frame", "stamp - log")]
        for topic in self.topics.values():
            ahead = "" if topic.ahead_s is None else f"{topic.ahead_s:+.3f} s"
            kind = topic.kind.replace("/msg/", "/")
            rows.append((topic.name, kind, str(topic.count), f"{topic.rate:.1f}", topic.frame, ahead))
        rows += [(name, kind.replace("/msg/", "/"), "", "", "", "not used") for name, kind in self.others.items()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
        return "\n".join(line.rstrip() for line in lines)


def survey(bag: BagFile, begin: int, end: int) -> BagSurvey:
    """Looks at the first messages of each topic with log times from `begin` to `end` (nanoseconds)."""
    seconds = max(1e-9, (bag.end - bag.begin) * 1e-9)
    used, others = {}, {}
    for topic in sorted(bag.topics.values(), key=lambda topic: topic.name):
        if topic.kind not in KINDS or not topic.count:
            others[topic.name] = topic.kind
            continue
        latched = topic.name.endswith(LATCHED)
        window = (None, None) if latched else (begin, end)
        found, samples, stamps = [], [], []
        for message in islice(bag.messages([topic.name], *window), SAMPLES):
            try:
                content = message.content()
            except DatasetError:
                continue  # an import counts it
            samples.append(content)
            inner = content.transforms[0] if getattr(content, "transforms", None) else content
            if hasattr(inner, "header"):
                stamps.append(header_stamp(inner))
                found.append((frame_name(inner.header.frame_id), (stamps[-1] - message.log) * 1e-9))
        ahead = float(np.median([it for _, it in found])) if found and not latched else None
        frame = found[0][0] if found else ""
        rate = topic.count / seconds if topic.count > 1 else 0.0
        interval = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else None
        used[topic.name] = TopicSurvey(topic.name, topic.kind, topic.count, rate, frame, ahead, interval, samples)
    return BagSurvey(used, others, seconds)


def clock_fault(topics: Sequence[TopicSurvey]) -> str | None:
    """Why the headers of topics have no common clock, or None."""
    known = sorted((topic for topic in topics if topic.ahead_s is not None), key=lambda topic: topic.ahead_s or 0.0)
    if len(known) < 2:
        return None
    first, last = known[0], known[-1]
    apart = (last.ahead_s or 0.0) - (first.ahead_s or 0.0)
    if apart <= MAX_CLOCK_SPREAD_S:
        return None
    return (
        f"the header stamps of {first.name} are {_spoken(apart)} before those of {last.name} by the times at which "
        "they were recorded: these are two clocks"
    )


def _spoken(seconds: float) -> str:
    return f"{seconds / 3600:.1f} hours" if seconds >= 3600 else f"{seconds:.0f} s"
