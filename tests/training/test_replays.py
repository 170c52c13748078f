"""When iterations are recorded, replayed and dropped. What a recording does is tested on a GPU, in test_gpu.py."""

import dataclasses
from functools import partial

import pytest
import torch
from helpers.trainings import guided_views

from drivesplat.kernels import capacity as rooms
from drivesplat.kernels import triton as on_gpu
from drivesplat.kernels.cuda_graphs import Graph
from drivesplat.settings.train import TrainSettings
from drivesplat.training.coarse_to_fine import TrainingImages
from drivesplat.training.cuda_graph import replays
from drivesplat.training.cuda_graph.replays import Extent, Replays, can_be_replayed

CPU = torch.device("cpu")
HUNDRED = Extent(100, 1.0)


class Played:
    """Replays whose recordings write down what is done, in place of doing it."""

    def __init__(self, monkeypatch):
        self.done, self.rooms, self.needed = [], [], 3000
        self.replays = Replays(True, CPU)
        monkeypatch.setattr(Replays, "_record", lambda _, *told: self.record(*told))
        monkeypatch.setattr(torch.cuda, "synchronize", lambda _: None)

    def record(self, image, gaussians, once):
        self.done.append(("recorded", image))
        self.rooms.append([need * gaussians for need in self.replays._needs[image]])
        replay = partial(self.done.append, ("replayed", image))
        self.replays._recorded[image] = Graph(
            replay, {"l1": torch.tensor(float(image))}, torch.tensor([self.needed], dtype=torch.int32), [self.needed],
            torch.tensor(0),
        )  # fmt: skip
        return self.replays._recorded[image]

    def iterate(self, image, shape=0, gaussians=HUNDRED):
        def once():
            self.done.append(("done", image))
            rooms.room_for(torch.tensor(self.needed))
            return {"l1": torch.tensor(float(image))}

        terms = self.replays.iterate(image, shape, gaussians, once)
        assert float(terms["l1"]) == image
        said = [word for word, of in self.done if of == image]
        self.done.clear()
        return said


def test_an_image_is_recorded_when_it_comes_again(monkeypatch):
    played = Played(monkeypatch)
    assert played.iterate(0) == ["done"], "how much room it needs is not known yet"
    assert played.iterate(0) == ["recorded", "replayed"]
    assert played.iterate(1) == ["done"]
    assert played.iterate(0) == ["replayed"]
    assert played.iterate(1) == ["recorded", "replayed"]


def test_what_tensors_elsewhere_were_recorded_for_is_recorded_anew(monkeypatch):
    """How much room the image needs is known by then."""
    played = Played(monkeypatch)
    assert [played.iterate(0) for _ in range(3)] == [["done"], ["recorded", "replayed"], ["replayed"]]
    assert [played.iterate(0, shape=1) for _ in range(2)] == [["recorded", "replayed"], ["replayed"]]


def test_lists_get_the_room_that_all_gaussians_would_need_which_there_may_be(monkeypatch):
    played = Played(monkeypatch)
    played.iterate(0, gaussians=Extent(100, 2.0))
    played.iterate(0, gaussians=Extent(120, 1.5))
    assert [round(room) for (room,) in played.rooms] == [5400]
    played.needed = 4200
    played.replays._recorded[0].needed[0] = played.needed
    played.iterate(0, gaussians=Extent(140, 1.2))
    played.iterate(0, shape=1, gaussians=Extent(200, 2.0))
    assert [round(room) for (room,) in played.rooms] == [5400, 2 * 200 * 4200 // 140], "what it needed the last time"


def test_what_gives_way_is_recorded_again_unless_nothing_is_any_more(monkeypatch):
    played = Played(monkeypatch)
    for _ in range(2):
        played.iterate(0)
    assert played.replays.give_way() and played.iterate(0) == ["recorded", "replayed"]
    played.replays.wanted = False
    assert not played.replays.give_way() and not played.replays._recorded


def test_what_had_too_little_room_is_recorded_anew(monkeypatch):
    played = Played(monkeypatch)
    for image in (0, 0, 1, 1):
        played.iterate(image)
    played.replays.check()
    assert played.iterate(0) == ["replayed"]
    played.replays._recorded[0].missing.add_(1)
    played.replays._recorded[0].needed[0] = 7000
    played.replays.check()
    assert played.iterate(0) == ["recorded", "replayed"]
    assert [round(room) for (room,) in played.rooms] == [3000, 3000, 7000]
    assert played.iterate(1) == ["replayed"], "it had room"


def test_memory_that_recordings_work_in_goes_with_the_last_of_them(monkeypatch):
    """torch forgets it then, and does not know it again."""
    played = Played(monkeypatch)
    played.replays._pool = (0, 1)
    for image in (0, 0, 1, 1):
        played.iterate(image)
    played.replays._recorded[0].missing.add_(1)
    played.replays.check()
    assert played.replays._pool == (0, 1)
    played.replays._recorded[1].missing.add_(1)
    played.replays.check()
    assert played.replays._pool is None


def test_where_nothing_is_to_be_recorded_all_is_done(monkeypatch):
    played = Played(monkeypatch)
    played.replays.wanted = False
    assert [played.iterate(0) for _ in range(3)] == [["done"]] * 3


@pytest.mark.parametrize(
    ("settings", "device", "compiles", "expected"),
    [
        ({}, "cuda", True, True),
        ({}, "cpu", True, False),
        ({}, "cuda", False, False),
        ({"cuda_graphs": False}, "cuda", True, False),
        ({"strategy": "default"}, "cuda", True, False),
    ],
)
def test_who_has_recordings(settings, device, compiles, expected, monkeypatch):
    monkeypatch.setattr(on_gpu, "compiles", lambda: compiles)
    chosen = TrainSettings(**settings)
    assert can_be_replayed(chosen, TrainingImages(guided_views(), chosen, 0), torch.device(device)) == expected


def test_of_classes_and_of_too_many_images_nothing_is_recorded(monkeypatch):
    monkeypatch.setattr(on_gpu, "compiles", lambda: True)
    views, gpu = guided_views(), torch.device("cuda")
    labelled = [dataclasses.replace(view, classes=torch.zeros_like(view.sky, dtype=torch.uint8)) for view in views]
    assert not can_be_replayed(TrainSettings(), TrainingImages(labelled, TrainSettings(), 0), gpu)
    monkeypatch.setattr(replays, "MOST_IMAGES", len(views) - 1)
    assert not can_be_replayed(TrainSettings(), TrainingImages(views, TrainSettings(), 0), gpu)


def test_without_memory_for_both_what_is_recorded_goes(monkeypatch, caplog):
    played, full = Played(monkeypatch), [False, True]
    for _ in range(2):
        played.iterate(0)

    def once():
        if full.pop():
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return "done"

    assert played.replays.make_room(once) == "done" and not played.replays.wanted
    assert "no GPU memory is left for recorded iterations" in caplog.text
    full[:] = [True]
    with pytest.raises(torch.cuda.OutOfMemoryError):  # nothing is recorded that could go
        played.replays.make_room(once)


def test_lists_have_the_room_they_need_or_what_they_needed_and_a_margin():
    assert rooms.room_for(torch.tensor(7)) == 7
    with rooms.counted() as needs:
        assert [rooms.room_for(torch.tensor(need)) for need in (5000, 0)] == [5000, 0]
    assert needs == [5000, 0]
    with rooms.given(needs) as lists:
        assert [rooms.room_for(torch.tensor(need)) for need in (9, 8)] == [rooms.LEAST + 7500, rooms.LEAST]
    assert [(int(needed), room) for needed, room in lists] == [(9, rooms.LEAST + 7500), (8, rooms.LEAST)]
    assert rooms.room_for(torch.tensor(3)) == 3
