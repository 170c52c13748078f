"""Contacts of the ego vehicle with other objects, whose fault they are, and those that are about to happen.

The rules are NAVSIM's, which are nuPlan's. What is the front and what is behind depends on the direction of motion: for
a vehicle that reverses, its rear end leads.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64

from drivesplat.scene.object_class import ObjectClass
from drivesplat.simulate.driven_run import DrivenRun
from drivesplat.simulate.footprints import OrientedBoxes, ego_boxes, other_boxes, overlapping, time_to_contact

STOPPED = 0.05
"""m/s up to which a vehicle in contact counts as stopped (nuPlan, NAVSIM)."""
TTC_STOPPED = 0.005
"""m/s below which the ego vehicle threatens nothing (NAVSIM)."""
AHEAD, BEHIND = np.cos(np.radians(30.0)), np.cos(np.radians(150.0))
"""Cosines between the direction of motion and the line from the trailing axle to an object that is ahead or behind."""
SAME_CONTACT = 1.0
"""Seconds without overlap up to which two contacts with one object are one: boxes of recorded objects jitter."""

SIDES = ("front", "rear", "lateral")
"""AlpaSim's names of where an object touches the ego vehicle."""

LaneLeft = Callable[[Bool[np.ndarray, " n"]], Bool[np.ndarray, " n"]]
"""Whether the ego vehicle has left its lane or the drivable area; asked at some of n steps, False at all others."""


class ContactKind(StrEnum):
    """What a contact is by NAVSIM's rules, of which the first that holds applies."""

    STOPPED_EGO = "stopped_ego"
    """The ego vehicle stands. Not at fault."""
    STOPPED_OBJECT = "stopped_object"
    """The object stands, or its class never moves. At fault."""
    REAR = "rear"
    """The object is behind. Not at fault."""
    FRONT = "front"
    """The leading end of the ego vehicle touches the object. At fault."""
    LATERAL = "lateral"
    """Any other. At fault where the ego vehicle has left its lane or the drivable area."""


@dataclass(frozen=True)
class Contact:
    """A contact with an object from a step to another, inclusive.

    `row` is the object's place among the run's others, `second` the time of the first step, `relative_speed` the
    horizontal one there in m/s. `side` is AlpaSim's, by the ends of the ego vehicle: one of SIDES. `counts` is False
    for a contact that existed at the first step.
    """

    row: int
    object_id: str
    object_class: ObjectClass
    first_step: int
    last_step: int
    second: float
    relative_speed: float
    kind: ContactKind
    side: str
    at_fault: bool
    counts: bool

    @property
    def score(self) -> float:
        """NAVSIM's factor: 0 at fault, 1/2 where the object is of a class that never moves, 1 otherwise."""
        if not (self.counts and self.at_fault):
            return 1.0
        return 0.0 if self.object_class.is_dynamic else 0.5


@dataclass(frozen=True, eq=False)
class Encounters:
    """The ego vehicle and k objects at n steps, all of which count: boxes, velocities (m/s), whether objects are
    `touching` the ego vehicle, and the seconds until they do if all velocities and headings stay (`ttc`, inf for
    never)."""

    run: DrivenRun
    ego: OrientedBoxes
    objects: OrientedBoxes
    velocity: Float64[np.ndarray, "n 3"]
    velocities: Float64[np.ndarray, "k n 3"]
    touching: Bool[np.ndarray, "k n"]
    ttc: Float64[np.ndarray, "k n"]

    @classmethod
    def of(cls, run: DrivenRun) -> "Encounters":
        """The encounters of a run whose steps all count."""
        ego, n = ego_boxes(run.ego_to_world, run.shape), len(run)
        objects, present = other_boxes(run.others, n)
        velocity = run.speed[:, None] * run.ego_to_world[:, :3, 0]
        velocities = np.array([other.velocities(run.seconds) for other in run.others]).reshape(-1, n, 3)
        ttc = np.where(present, time_to_contact(ego, objects, velocities - velocity), np.inf)
        return cls(run, ego, objects, velocity, velocities, present & overlapping(ego, objects), ttc)

    @property
    def direction(self) -> Float64[np.ndarray, " n"]:
        """1 where the ego vehicle drives forward or stands, -1 where it reverses."""
        return np.where(self.run.speed < 0.0, -1.0, 1.0)

    def bearing(self, after: Float64[np.ndarray, "k n"]) -> Float64[np.ndarray, "k n"]:
        """The cosine between the direction of motion and the line from the trailing axle (the rear axle, or the front
        axle of a vehicle that reverses) to the centres of objects, `after` some seconds in which all move on."""
        pose, shape = self.run.ego_to_world, self.run.shape
        axle = pose[:, :2, 3] + np.where(self.direction < 0.0, shape.wheelbase, 0.0)[:, None] * pose[:, :2, 0]
        relative = (self.velocities - self.velocity)[..., :2]
        to_object = self.objects.centre[..., :2] - axle + after[..., None] * relative
        along = (to_object * (self.direction[:, None] * self.ego.forward)).sum(axis=-1)
        return along / np.maximum(np.linalg.norm(to_object, axis=-1), 1e-9)

    def end_touched(self, side: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, "k n"]:
        """Whether objects touch the front end (`side` 1) or the rear end (-1) of the ego vehicle."""
        return self.touching & overlapping(self.ego.end(side), self.objects)


def contacts(around: Encounters, lane_left: LaneLeft) -> list[Contact]:
    """All contacts, by their first steps."""
    found = []
    spans = [(k, *span) for k, row in enumerate(around.touching) for span in _spans(row, around.run.seconds)]
    if spans:
        begins = np.zeros(len(around.run), dtype=bool)
        begins[[first for _, first, _ in spans]] = True
        left = lane_left(begins)
        kinds, sides = contact_kinds(around), contact_sides(around)
        for k, first, last in spans:
            kind, other = ContactKind(kinds[k, first]), around.run.others[k]
            fault = kind in (ContactKind.STOPPED_OBJECT, ContactKind.FRONT)
            relative = around.velocities[k, first, :2] - around.velocity[first, :2]
            found.append(
                Contact(
                    k, other.id, other.object_class, first, last, float(around.run.seconds[first]),
                    float(np.linalg.norm(relative)), kind, next(name for name in sides if sides[name][k, first]),
                    fault or (kind is ContactKind.LATERAL and bool(left[first])), first > 0,
                )
            )  # fmt: skip
    return sorted(found, key=lambda contact: contact.first_step)


def contact_kinds(around: Encounters) -> np.ndarray:
    """The kinds (k, n) that contacts have that begin at each step, whether or not there is one."""
    stopped_ego = np.abs(around.run.speed) <= STOPPED
    stopped = np.linalg.norm(around.velocities[..., :2], axis=-1) <= STOPPED
    stopped |= np.array([not other.object_class.is_dynamic for other in around.run.others], dtype=bool)[:, None]
    behind = around.bearing(np.zeros(stopped.shape)) < BEHIND
    front = around.end_touched(around.direction)
    kinds = [ContactKind.STOPPED_EGO, ContactKind.STOPPED_OBJECT, ContactKind.REAR, ContactKind.FRONT]
    holds = [np.broadcast_to(stopped_ego, stopped.shape), stopped, behind, front]
    return np.select(holds, [str(kind) for kind in kinds], str(ContactKind.LATERAL))


def contact_sides(around: Encounters) -> dict[str, Bool[np.ndarray, "k n"]]:
    """AlpaSim's sides: where an object touches the front end of the ego vehicle, else its rear end, else neither."""
    front, rear = (around.end_touched(np.full(len(around.run), side)) for side in (1.0, -1.0))
    return dict(zip(SIDES, (front, rear & ~front, around.touching & ~front & ~rear), strict=True))


def threatened(around: Encounters, known: Sequence[Contact], horizon: float, lane_left: LaneLeft) -> np.ndarray:
    """Whether the ego vehicle, at each of n steps, is in a contact at its fault or will be within `horizon` seconds if
    all velocities and headings stay: (n,) bool.

    NAVSIM's rule: the ego vehicle moves, and the object will then be ahead of it; or it is not behind it, and the ego
    vehicle has left its lane or the drivable area. Objects that it touches without its fault do not count. NAVSIM
    compares the future place of the object with the present one of the ego vehicle, which has vehicles that follow
    closely ahead of it; here both move on.
    """
    soon = around.ttc <= horizon
    for contact in known:
        soon[contact.row, contact.first_step : contact.last_step + 1] = False
    soon &= np.abs(around.run.speed) >= TTC_STOPPED
    bearing = around.bearing(np.where(soon, around.ttc, 0.0))
    fault = bearing > AHEAD
    asked = (soon & ~fault & (bearing >= BEHIND)).any(axis=0)
    fault |= (bearing >= BEHIND) & lane_left(asked)
    found = (soon & fault).any(axis=0)
    for contact in known:
        if contact.counts and contact.at_fault:
            found[contact.first_step : contact.last_step + 1] = True
    return found


def counted(around: Encounters, known: Sequence[Contact]) -> Bool[np.ndarray, "k n"]:
    """Where an object is not in a contact that existed at the first step."""
    mask = np.ones(around.touching.shape, dtype=bool)
    for contact in known:
        if not contact.counts:
            mask[contact.row, contact.first_step : contact.last_step + 1] = False
    return mask


def _spans(touching: np.ndarray, seconds: np.ndarray) -> list[tuple[int, int]]:
    """The first and last steps of contacts with one object: touching (n,) at times (n,)."""
    steps = np.flatnonzero(touching)
    if not len(steps):
        return []
    apart = (np.diff(steps) > 1) & (np.diff(seconds[steps]) > SAME_CONTACT)
    return [(int(part[0]), int(part[-1])) for part in np.split(steps, np.flatnonzero(apart) + 1)]
