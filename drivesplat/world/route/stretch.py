"""A stretch of the drive: the streets near it and the road users that it meets, as a `Street`.

What is far away is left out or simplified: details of houses, then what stands on sidewalks, then houses.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import rigid
from drivesplat.settings.world import WorldSettings
from drivesplat.world.route import scenery
from drivesplat.world.route.grid import FORWARD, Block
from drivesplat.world.route.path import LanePath
from drivesplat.world.route.scenery import House, Parked, StreetScenery, crossing_ground, grass, placed
from drivesplat.world.route.tour import ego_path
from drivesplat.world.route.traffic import MAX_LIFE_S, PERIOD_S, Traffic
from drivesplat.world.shapes.body import RigidBody
from drivesplat.world.shapes.mesh import ColoredMesh, concatenate
from drivesplat.world.shapes.vehicles import ego_rear, ego_vehicle
from drivesplat.world.street.furniture import LAMP_ARM
from drivesplat.world.street.objects import EGO_BODY, EGO_VEHICLE, StreetObject, fixed
from drivesplat.world.street.road import STRAIGHT
from drivesplat.world.street.street import Street

STRETCH_S = 10
"""Seconds of a stretch."""
MARGIN_S = 1.0
"""Seconds before and after the recordings of a stretch at which it holds, too."""
DETAILED, FURNISHED, HOUSES = 100.0, 60.0, 420.0
"""Distances from the ego vehicle (metres) within which houses have details, streets have furniture and trees, and there
are houses."""
LINE_FURNISHED, LINE_HOUSES = 300.0, 800.0
"""The same distances of furniture and houses along the street that the ego vehicle sees before it."""
BOXED, PARKED, LIT = 90.0, 240.0, 120.0
"""Distances within which parked vehicles are objects of their own, are there at all, and lamps shine."""
FACING = 0.3
"""Least cosine between the directions of the ego vehicle and of a street that it sees before it."""
HORIZON = 3000.0
"""Metres to which the ground extends."""
BELOW = -0.05
"""Height in metres of the ground beyond the streets."""
BURIED = -1000.0
"""Height in metres of road users before and after they exist."""
LAMP_LIGHT = 6.6
"""Height in metres of the light of street lamps."""


@dataclass(frozen=True)
class LocalPath:
    """A path of the grid frame in a frame with its origin at `origin` (2,), from second `begin` to `end`."""

    path: LanePath
    origin: np.ndarray
    begin: float = -np.inf
    end: float = np.inf
    moves: bool = True

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        """Object to local frame (n, 4, 4); far below the ground at other times."""
        poses = self.path.poses(seconds)
        poses[:, :2, 3] -= self.origin
        poses[(seconds < self.begin) | (seconds > self.end), 2, 3] += BURIED
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
        self.traffic = Traffic(world, self.ego, world.seconds + MARGIN_S)

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
            path = LocalPath(user.path, origin, user.begin, user.end)
            objects.append(StreetObject(user.name, body, path, category, attribute))
        if self.world.own_car:
            objects.append(fixed(EGO_VEHICLE, ego_rear(), ego))
        if self.world.lidar.ego_returns:
            objects.append(fixed(EGO_BODY, ego_vehicle(), ego))
        ordered = tuple(sorted(objects, key=lambda item: item.moves))
        return Stretch(Street(ordered, near.lamps(), STRAIGHT, ego, None), origin)


class _Surroundings:
    """The streets near `places` (n, 2) of the ego vehicle, which faces along `ahead` (n, 2), in a frame with its origin
    at `origin` (2,)."""

    def __init__(self, world: WorldSettings, places: np.ndarray, ahead: np.ndarray, origin: np.ndarray):
        assert world.route is not None
        self._world, self._length = world, world.route.block_m
        self._places, self._ahead, self._origin = places, ahead, origin
        self._streets = [*self._near_streets()]

    def _near_streets(self) -> Iterator[tuple[Block, np.ndarray, float, bool]]:
        """Each street within HOUSES, or before the ego vehicle within LINE_HOUSES: its middle (2,), its distance, and
        whether it is furnished."""
        length = self._length
        low = np.floor((self._places.min(axis=0) - LINE_HOUSES) / length).astype(int)
        high = np.ceil((self._places.max(axis=0) + LINE_HOUSES) / length).astype(int)
        shift = np.round(self._origin / length).astype(int)
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                for heading in (0, 1):
                    start = length * np.array([x, y], dtype=float)
                    middle = start + length / 2 * FORWARD[heading]
                    between = middle - self._places
                    along, across = np.abs(between[:, heading]), np.abs(between[:, 1 - heading])
                    distance = np.hypot(np.maximum(along - length / 2, 0.0), across)
                    forward = (between * self._ahead).sum(axis=1)
                    # on the same street line, before the ego vehicle
                    facing = np.abs(self._ahead[:, heading]) > FACING
                    before = distance[facing & (across < length / 4) & (forward > 0)].min(initial=np.inf)
                    if distance.min() <= HOUSES or before <= LINE_HOUSES:
                        furnished = distance.min() <= FURNISHED or before <= LINE_FURNISHED
                        block = Block((x + int(shift[0]), y + int(shift[1])), heading)
                        yield block, start, float(distance.min()), bool(furnished)

    def _scenery(self, block: Block) -> StreetScenery:
        return StreetScenery(block, self._length, self._world.random_seed)

    def static(self) -> Iterator[ColoredMesh]:
        """Ground, houses, furniture and trees, and parked vehicles that are far away."""
        length, random_seed = self._length, self._world.random_seed
        for block, start, distance, furnished in self._streets:
            own = (block, length, random_seed)
            yield from placed([_shell(*own)], start, block.heading)
            if furnished:
                yield from placed([_furniture(*own)], start, block.heading)
            if distance <= DETAILED:
                for house in self._scenery(block).houses():
                    center = placed_point(house.center, start, block.heading)
                    if np.linalg.norm(self._places - center, axis=1).min() <= DETAILED:
                        yield from placed([_front(house)], start, block.heading)
            if block.heading == 0:
                shift = 37.0 * block.crossing[0] + 91.0 * block.crossing[1]
                yield from placed([_with_texture(crossing_ground(), shift % 4000.0)], start, 0)
                yield grass(tuple(start + scenery.SIDEWALK), tuple(start + length - scenery.SIDEWALK))
        yield grass((-HORIZON, -HORIZON), (HORIZON, HORIZON), BELOW)
        for car, start, heading, near in self._all_parked():
            if not near:
                yield car.vehicle[0].moved((*placed_point(np.array([car.x, car.y]), start, heading), 0.0),
                                            car.heading + np.pi / 2 * heading)  # fmt: skip

    def parked(self) -> list[StreetObject]:
        """Parked vehicles that are near."""
        found = []
        for car, start, heading, near in self._all_parked():
            if near:
                mesh, category = car.vehicle
                x, y = placed_point(np.array([car.x, car.y]), start, heading).tolist()
                turned = Rotation.from_euler("z", car.heading + np.pi / 2 * heading).as_matrix()
                path = Standing(rigid(turned, np.array([x, y, 0.0])))
                east, north = np.round(np.array([x, y]) + self._origin, 1)
                name = f"parked {east:.1f} {north:.1f}"
                found.append(StreetObject(name, RigidBody(mesh), path, category, "vehicle.parked"))
        return found

    def _all_parked(self) -> Iterator[tuple[Parked, np.ndarray, int, bool]]:
        """Parked vehicles on furnished streets, the start (2,) and heading of their street, and whether they are near.
        """
        for block, start, _, furnished in self._streets:
            for car in self._scenery(block).parked(self._world.parked) if furnished else ():
                place = placed_point(np.array([car.x, car.y]), start, block.heading)
                distance = np.linalg.norm(self._places - place, axis=1).min()
                if distance <= PARKED:
                    yield car, start, block.heading, bool(distance <= BOXED)

    def lamps(self) -> np.ndarray:
        """The lights (m, 3) of the street lamps that are near."""
        found = [np.zeros((0, 3))]
        for block, start, _, furnished in self._streets:
            for x, y in self._scenery(block).lamps().tolist() if furnished else ():
                place = placed_point(np.array([x, y - np.sign(y) * LAMP_ARM]), start, block.heading)
                if np.linalg.norm(self._places - place, axis=1).min() <= LIT:
                    found.append(np.array([[*place, LAMP_LIGHT]]))
        return np.concatenate(found)


def placed_point(point: np.ndarray, start: np.ndarray, heading: int) -> np.ndarray:
    """A point (2,) in the frame of a street in the frame in which the street begins at `start` (2,)."""
    x, y = FORWARD[heading], FORWARD[heading + 1]
    return start + point[0] * x + point[1] * y


def _with_texture(mesh: ColoredMesh, shift: float) -> ColoredMesh:
    return ColoredMesh(
        mesh.vertices, mesh.texture + (shift, 0.0, 0.0), mesh.faces, mesh.material, mesh.color, mesh.surface_class
    )


@lru_cache(maxsize=512)
def _shell(block: Block, length: float, random_seed: int) -> ColoredMesh:
    """The ground of a street, and its houses without details."""
    own = StreetScenery(block, length, random_seed)
    return concatenate([*own.ground(), *(house.mesh() for house in own.houses())])


@lru_cache(maxsize=16)
def _furniture(block: Block, length: float, random_seed: int) -> ColoredMesh:
    """What stands on the sidewalks of a street, and its hedges and fences."""
    own = StreetScenery(block, length, random_seed)
    return concatenate([*own.trees(), *own.furniture(), *own.barriers()])


@lru_cache(maxsize=64)
def _front(house: House) -> ColoredMesh:
    return house.front()
