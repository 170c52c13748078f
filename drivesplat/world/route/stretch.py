"""A stretch of the drive: the streets near it and the road users that it meets, as a `Street`.

What is far away is left out or simplified: details of houses, then what stands on sidewalks, then houses.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import rigid
from drivesplat.settings.world import WorldSettings
from drivesplat.world.layout import SIDEWALK
from drivesplat.world.route.grid import FORWARD, LEFT, CityBlock
from drivesplat.world.route.path import LanePath
from drivesplat.world.route.scenery import Parked, StreetScenery, crossing_ground, grass
from drivesplat.world.route.tour import ego_path
from drivesplat.world.route.traffic import MAX_LIFE_S, PERIOD_S, RoadUsers
from drivesplat.world.shapes.body import RigidBody
from drivesplat.world.shapes.mesh import ColoredMesh, concatenate
from drivesplat.world.shapes.vehicles import ego_rear, ego_vehicle
from drivesplat.world.street.objects import EGO_BODY, EGO_VEHICLE, StreetObject, fixed
from drivesplat.world.street.road import STRAIGHT
from drivesplat.world.street.roadside import LAMP_ARM
from drivesplat.world.street.street import Street

STRETCH_S = 10
"""Seconds of a stretch."""
MARGIN_S = 1.0
"""Seconds before and after the recordings of a stretch at which it holds, too."""
DETAILED, FURNISHED, HOUSES = 75.0, 60.0, 420.0
"""Distances from the ego vehicle (metres) within which houses have details, streets have furniture and trees, and there
are houses."""
LINE_FURNISHED, LINE_TREES, LINE_HOUSES = 120.0, 250.0, 800.0
"""The same distances of furniture, trees and houses along the street that the ego vehicle sees before it."""
BOXED, PARKED, LIT = 90.0, 150.0, 120.0
"""Distances within which parked vehicles are objects of their own, are there at all, and lamps shine."""
PARKED_LENGTH = 130.0
"""Metres of street for which the settings count parked vehicles, as on the one street of other worlds."""
FACING = 0.3
"""Least cosine between the directions of the ego vehicle and of a street that it sees before it."""
HORIZON = 3000.0
"""Metres to which the ground extends."""
BELOW = -0.05
"""Height in metres of the ground beyond the streets."""
LAMP_LIGHT = 6.6
"""Height in metres of the light of street lamps."""


@dataclass(frozen=True)
class LocalPath:
    """A path of the grid frame in a frame with its origin at `origin` (2,)."""

    path: LanePath
    origin: np.ndarray
    moves: bool = True

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        """Object to local frame (n, 4, 4)."""
        poses = self.path.poses(seconds)
        poses[:, :2, 3] -= self.origin
        return poses

    def distance(self, seconds: np.ndarray) -> np.ndarray:
        """Metres travelled (n,)."""
        return self.path.distance(seconds)


@dataclass(frozen=True)
class Standing:
    """The path of an object that stands still: its `pose` (4, 4)."""

    pose: np.ndarray
    moves: bool = False

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        """Object to local frame (n, 4, 4)."""
        return np.tile(self.pose, (len(seconds), 1, 1))

    def distance(self, seconds: np.ndarray) -> np.ndarray:
        """Metres travelled (n,): none."""
        return np.zeros(len(seconds))


@dataclass(frozen=True)
class Stretch:
    """A stretch of a drive: its `street`, whose frame has its origin at `origin` (2,) in the grid frame."""

    street: Street
    origin: np.ndarray


class RouteDrive:
    """The route and the traffic of a world with a route."""

    def __init__(self, world: WorldSettings):
        assert world.route is not None
        self.world, self.route = world, world.route
        # road users may meet the ego vehicle after the end, and exist long after that
        self.ego = ego_path(self.route, world.random_seed, world.seconds + 2 * MAX_LIFE_S + 2 * PERIOD_S)
        self.traffic = RoadUsers(world, self.ego, world.seconds + MARGIN_S)

    @property
    def stretches(self) -> int:
        """Number of stretches. The first key frame belongs to the first one, which has one key frame more."""
        return max(1, -(-(self.world.key_frames - 1) // self._key_frames))

    @property
    def _key_frames(self) -> int:
        return STRETCH_S * self.world.key_frame_hz

    def stretch_of(self, key_frame: int) -> int:
        """The index of the stretch to which a key frame belongs."""
        return max(0, key_frame - 1) // self._key_frames

    def key_frames(self, index: int) -> tuple[int, int]:
        """The first and the last key frame of a stretch."""
        first = index * self._key_frames + (index > 0)
        return first, min((index + 1) * self._key_frames, self.world.key_frames - 1)

    def stretch(self, index: int) -> Stretch:
        """The stretch of that index, which does not depend on the length of the drive."""
        begin, end = STRETCH_S * index - MARGIN_S, STRETCH_S * (index + 1) + MARGIN_S
        poses = self.ego.poses(np.linspace(begin, end, 2 * (STRETCH_S + 2) + 1))
        places = poses[:, :2, 3]
        block = self.route.block_m
        origin = block * np.round(places[len(places) // 2] / block)
        near = _Surroundings(self.world, places - origin, poses[:, :2, 0], origin)
        ego = LocalPath(self.ego, origin)
        objects = [fixed("scenery", concatenate([*near.static()])), *near.parked()]
        for user in self.traffic.near(begin, end):
            body, category, attribute = user.body()
            path = LocalPath(user.path, origin)
            objects.append(StreetObject(user.name, body, path, category, attribute, user.begin, user.end))
        if self.world.own_car:
            objects.append(fixed(EGO_VEHICLE, ego_rear(), ego))
        if self.world.lidar.ego_returns:
            objects.append(fixed(EGO_BODY, ego_vehicle(), ego))
        ordered = tuple(sorted(objects, key=lambda item: item.moves))
        return Stretch(Street(ordered, near.lamps(), STRAIGHT, ego, None), origin)


@dataclass(frozen=True)
class NearStreet:
    """A street near the ego vehicle: the place (2,) where it `begins`, its distance from the ego vehicle in metres, and
    whether it has trees and furniture."""

    block: CityBlock
    begins: np.ndarray
    distance: float
    has_trees: bool
    is_furnished: bool

    def place(self, x: float, y: float) -> np.ndarray:
        """The place (2,) of a point in the frame of the street."""
        return self.begins + x * FORWARD[self.block.heading] + y * LEFT[self.block.heading]

    def put(self, mesh: ColoredMesh) -> ColoredMesh:
        """A mesh in the frame of the street."""
        return mesh.moved((*self.begins, 0.0), np.pi / 2 * self.block.heading)


class _Surroundings:
    """The streets near `places` (n, 2) of the ego vehicle, which faces along `ahead` (n, 2), in a frame with its origin
    at `origin` (2,)."""

    def __init__(self, world: WorldSettings, places: np.ndarray, ahead: np.ndarray, origin: np.ndarray):
        assert world.route is not None
        self._world, self._length = world, world.route.block_m
        self._places, self._ahead, self._origin = places, ahead, origin
        self._streets = [*self._near_streets()]

    def _near_streets(self) -> Iterator[NearStreet]:
        """Each street within HOUSES, or before the ego vehicle within LINE_HOUSES."""
        length = self._length
        low = np.floor((self._places.min(axis=0) - LINE_HOUSES) / length).astype(int)
        high = np.ceil((self._places.max(axis=0) + LINE_HOUSES) / length).astype(int)
        shift_x, shift_y = np.round(self._origin / length).astype(int).tolist()
        for x, y, heading in product(range(low[0], high[0] + 1), range(low[1], high[1] + 1), (0, 1)):
            begins = length * np.array([x, y], dtype=float)
            between = begins + length / 2 * FORWARD[heading] - self._places
            along, across = np.abs(between[:, heading]), np.abs(between[:, 1 - heading])
            distances = np.hypot(np.maximum(along - length / 2, 0.0), across)
            facing = np.abs(self._ahead[:, heading]) > FACING
            before = (between * self._ahead).sum(axis=1) > 0
            distance = float(distances.min())
            seen = float(distances[before & facing & (across < length / 4)].min(initial=np.inf))
            # houses at the corners of the street ahead belong to the streets that cross it
            line = min(seen, float(distances[before & self._crosses(begins, heading)].min(initial=np.inf)))
            if distance <= HOUSES or line <= LINE_HOUSES:
                trees, furnished = (distance <= FURNISHED or seen <= reach for reach in (LINE_TREES, LINE_FURNISHED))
                yield NearStreet(CityBlock((x + shift_x, y + shift_y), heading), begins, distance, trees, furnished)

    def _crosses(self, begins: np.ndarray, heading: int) -> np.ndarray:
        """Whether a street begins or ends on the line along which the ego vehicle faces: (n,) bool."""
        ends = (begins - self._places, begins + self._length * FORWARD[heading] - self._places)
        aside = [np.abs(x * self._ahead[:, 1] - y * self._ahead[:, 0]) for x, y in (end.T for end in ends)]
        return np.minimum(*aside) < self._length / 4

    def _distance(self, place: np.ndarray) -> float:
        """The least distance in metres of a place (2,) from the ego vehicle."""
        return float(np.linalg.norm(self._places - place, axis=1).min())

    def _scenery(self, block: CityBlock) -> StreetScenery:
        return StreetScenery(block, self._length, self._world.random_seed)

    def static(self) -> Iterator[ColoredMesh]:
        """Ground, houses, furniture and trees, and parked vehicles that are far away."""
        for street in self._streets:
            block, begins, own = street.block, street.begins, self._scenery(street.block)
            yield from map(street.put, own.ground())
            for house in own.houses():
                yield street.put(house.mesh())
                if street.is_furnished and self._distance(street.place(*house.center)) <= DETAILED:
                    yield street.put(house.front())
            if street.has_trees:
                yield from map(street.put, own.trees())
            if street.is_furnished:
                yield from map(street.put, [*own.furniture(), *own.barriers()])
            if block.heading == 0:
                shift = (37.0 * block.crossing[0] + 91.0 * block.crossing[1]) % 4000.0
                crossing = crossing_ground()
                yield replace(crossing, texture=crossing.texture + np.array([shift, 0.0, 0.0])).moved((*begins, 0.0))
                yield grass(begins + SIDEWALK, begins + self._length - SIDEWALK)
        yield grass(np.full(2, -HORIZON), np.full(2, HORIZON), BELOW)
        for car, street, distance in self._all_parked():
            if distance > BOXED:
                yield street.put(car.vehicle[0].moved((car.x, car.y, 0.0), car.heading))

    def parked(self) -> list[StreetObject]:
        """Parked vehicles that are near."""
        found = []
        for car, street, distance in self._all_parked():
            if distance <= BOXED:
                mesh, category = car.vehicle
                turned = Rotation.from_euler("z", car.heading + np.pi / 2 * street.block.heading).as_matrix()
                path = Standing(rigid(turned, np.array([*street.place(car.x, car.y), 0.0])))
                east, north = street.block.crossing
                name = f"parked {east} {north} {street.block.heading} {car.number}"
                found.append(StreetObject(name, RigidBody(mesh), path, category, "vehicle.parked"))
        return found

    def _all_parked(self) -> Iterator[tuple[Parked, NearStreet, float]]:
        """The parked vehicles within PARKED, their streets and their distances."""
        number = round(self._world.parked * self._length / PARKED_LENGTH)
        for street in self._streets:
            for car in self._scenery(street.block).parked(number) if street.has_trees else ():
                distance = self._distance(street.place(car.x, car.y))
                if distance <= PARKED:
                    yield car, street, distance

    def lamps(self) -> np.ndarray:
        """The lights (m, 3) of the street lamps that are near."""
        found = [np.zeros((0, 3))]
        for street in self._streets:
            for x, y in self._scenery(street.block).lamps().tolist() if street.is_furnished else ():
                place = street.place(x, y - np.sign(y) * LAMP_ARM)
                if self._distance(place) <= LIT:
                    found.append(np.array([[*place, LAMP_LIGHT]]))
        return np.concatenate(found)
