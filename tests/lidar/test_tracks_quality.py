"""Discovered tracks of a scene, compared with annotated ones; and the record of both."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.street_scans import Mover, street_scans

from drivesplat.errors import DatasetError, ResultError
from drivesplat.lidar.objects import tracks
from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.lidar.objects.discover import discovered
from drivesplat.lidar.objects.record import DiscoveredTracks, read_discovered, write_discovered
from drivesplat.lidar.objects.tracks import discovered_tracks, searched, tracks_of, tracks_quality
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene, Track
from drivesplat.settings.discover import DiscoverSettings

SECONDS = 0.1 * np.arange(46)
KEY_FRAMES = SECONDS[::5]
AHEAD, PARKED = Mover((12.0, 0.0), (7.0, 0.0)), Mover((20.0, 5.5))
ANY = DiscoverSettings()


def annotated(mover: Mover, name: str, aside: float = 0.0) -> Track:
    """The track of a mover, all of its boxes `aside` metres to the left."""
    poses = np.tile(np.eye(4), (len(KEY_FRAMES), 1, 1))
    cos, sin = np.cos(mover.heading), np.sin(mover.heading)
    poses[:, :2, :2] = [[cos, -sin], [sin, cos]]
    poses[:, :2, 3] = mover.at(KEY_FRAMES) + aside * np.array([-sin, cos])
    poses[:, 2, 3] = 0.5 * mover.size[2]
    times, samples = np.round(KEY_FRAMES * 1e6).astype(np.int64), np.arange(len(KEY_FRAMES))
    return Track(name, ObjectClass.CAR, "car", np.array(mover.size), times, samples, poses, np.full(len(times), 4))


def scene_of(tiny_scene: Scene, *tracks: Track) -> Scene:
    """A drive of the same key frames, without images."""
    sweeps = (replace(tiny_scene.sweeps[0], timestamp=0),)
    times = np.round(KEY_FRAMES * 1e6).astype(np.int64)
    return replace(tiny_scene, frames=(), sweeps=sweeps, tracks=tracks, key_frame_timestamps=times)


@pytest.fixture(scope="module")
def records() -> ScanRecords:
    return ScanRecords(street_scans([AHEAD, PARKED], SECONDS), ["ahead", "parked"])


@pytest.fixture(scope="module")
def search(tiny_scene, records) -> tuple[DiscoveredTracks, list[Discovered]]:
    """What is found in a scene in which both vehicles are annotated, and the objects that it is made of."""
    objects: list[Discovered] = []

    def kept(scans: list[RecordedScan], threads: int) -> list[Discovered]:
        objects.extend(discovered(scans, threads))
        return objects

    scene = scene_of(tiny_scene, annotated(AHEAD, "ahead"), annotated(PARKED, "parked"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracks, "discovered", kept)
        return discovered_tracks(scene, records, ANY), objects


@pytest.fixture(scope="module")
def objects(search) -> list[Discovered]:
    return search[1]


def test_an_annotated_mover_is_found_and_a_parked_car_is_none(tiny_scene, search):
    found, scene = search[0], scene_of(tiny_scene)
    (track,) = found.tracks
    assert (found.lidar, found.scans, track.id, track.category) == ("TOP", 46, "found_0001", "discovered.car")
    np.testing.assert_array_equal(track.timestamps, scene.key_frame_timestamps[track.sample_indices])
    quality = found.quality["vehicle"]
    assert (quality["movers"], quality["tracks"], quality["recall"], quality["precision"]) == (1, 1, 1.0, 1.0)
    assert quality["lateral_m"] < 0.15 and quality["along_m"] < 0.35
    assert quality["distance_m"] == pytest.approx(np.hypot(quality["along_m"], quality["lateral_m"]), abs=0.1)
    assert found.quality["all"] == quality
    assert found.quality["human"] == {"movers": 0, "tracks": 0} | dict.fromkeys(
        ("recall", "precision", "along_m", "lateral_m", "distance_m")
    )


def quality_of(scene: Scene, objects: list[Discovered], records: ScanRecords) -> dict[str, Any]:
    return tracks_quality(scene, tracks_of(scene, objects), records.scans, records.tracks)["vehicle"]


def test_a_mover_elsewhere_is_missed_and_its_track_wrong(tiny_scene, records, objects):
    quality = quality_of(scene_of(tiny_scene, annotated(AHEAD, "ahead", aside=3.0)), objects, records)
    assert (quality["movers"], quality["recall"], quality["precision"]) == (1, 0.0, 0.0)
    assert quality["lateral_m"] is None
    near = quality_of(scene_of(tiny_scene, annotated(AHEAD, "ahead", aside=1.0)), objects, records)
    assert near["lateral_m"] == pytest.approx(1.0, abs=0.15)


def test_without_annotations_nothing_is_compared(tiny_scene, records):
    found = discovered_tracks(scene_of(tiny_scene), replace(records, scans=records.scans[:3]), ANY)
    assert found.scans == 3 and found.quality is None


def test_of_several_lidars_the_richest_or_the_named_one_is_searched(tiny_scene, records):
    few = [replace(scan, lidar="FRONT") for scan in records.scans[:3]]
    scene, both = scene_of(tiny_scene), replace(records, scans=[*few, *records.scans])
    assert searched(scene, both, None) == ("TOP", records.scans)
    assert searched(scene, both, "FRONT") == ("FRONT", few)
    assert discovered_tracks(scene, both, DiscoverSettings(lidar="FRONT")).scans == 3
    with pytest.raises(DatasetError, match=r"no scan of discover\.lidar BACK; choose one of FRONT, TOP"):
        discovered_tracks(scene, both, DiscoverSettings(lidar="BACK"))


def test_without_lidar_the_search_is_refused_and_a_single_scan_tells_nothing(tiny_scene, records, caplog):
    with pytest.raises(DatasetError, match="no LiDAR scan; moving objects cannot be discovered without LiDAR"):
        discovered_tracks(scene_of(tiny_scene), replace(records, scans=[]), ANY)
    with caplog.at_level(logging.WARNING):
        found = discovered_tracks(scene_of(tiny_scene), replace(records, scans=records.scans[:1]), ANY)
    assert found.tracks == () and "a single scan" in caplog.text


def test_a_record_is_read_as_it_was_written_and_others_are_refused(tmp_path, tiny_scene, records, objects):
    scene = scene_of(tiny_scene, annotated(AHEAD, "ahead"))
    found = DiscoveredTracks("TOP", 46, tuple(tracks_of(scene, objects)), {"vehicle": {"recall": 1.0, "along_m": None}})
    write_discovered(tmp_path / "discovered.json", found)
    again = read_discovered(tmp_path / "discovered.json")
    assert isinstance(again, DiscoveredTracks) and again.quality == found.quality
    np.testing.assert_array_equal(again.tracks[0].object_to_world, found.tracks[0].object_to_world)
    assert again.tracks[0].object_class is ObjectClass.CAR
    (tmp_path / "discovered.json").write_text('{"schema": 1, "provenance": {}}')
    with pytest.raises(ResultError, match="discover"):
        read_discovered(tmp_path / "discovered.json")
