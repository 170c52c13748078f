"""When iterations are recorded, replayed and dropped. What a recording does is tested on a GPU, in test_gpu.py."""

import dataclasses
from functools import partial

import pytest
import torch
from test_training import guided_views

from drivesplat import on_gpu
from drivesplat.on_gpu import rooms
from drivesplat.settings.train import TrainSettings
from drivesplat.training import replays
from drivesplat.training.coarse_to_fine import TrainingImages
from drivesplat.training.replays import Recording, Replays, can_be_replayed

CPU = torch.device("cpu")


class Played:
    """Replays whose recordings write down what is done, in place of doing it."""

    def __init__(self, monkeypatch, patience=0):
        self.done = []
        self.replays = Replays(True, CPU, patience)
        monkeypatch.setattr(Replays, "_record", lambda _, *told: self.record(*told))

    def record(self, image, once):
        self.done.append(("recorded", image))
        replay = partial(self.done.append, ("replayed", image))
        self.replays._recorded[image] = Recording(replay, {"l1": torch.tensor(float(image))})
        return self.replays._recorded[image]

    def iterate(self, step, image, shape=0, settled=False):
        def once():
            self.done.append(("done", image))
            return {"l1": torch.tensor(float(image))}

        terms = self.replays.iterate(step, image, shape, once, settled)
        assert float(terms["l1"]) == image
        said = [word for word, of in self.done if of == image]
        self.done.clear()
        return said


def test_an_image_is_recorded_when_it_comes_again_and_the_number_of_gaussians_has_settled(monkeypatch):
    played = Played(monkeypatch, patience=150)
    assert played.iterate(10, 0) == ["done"]
    assert played.iterate(12, 0) == ["done"], "their number may change any time"
    assert played.iterate(160, 1) == ["done"], "how much room it needs is not known yet"
    assert played.iterate(161, 0) == ["recorded", "replayed"]
    assert played.iterate(162, 0) == ["replayed"]
    assert played.iterate(163, 1) == ["recorded", "replayed"]


def test_where_their_number_will_stay_nobody_waits(monkeypatch):
    played = Played(monkeypatch, patience=150)
    assert played.iterate(10, 0, settled=True) == ["done"]
    assert played.iterate(11, 0, settled=True) == ["recorded", "replayed"]


def test_nothing_recorded_outlives_another_number_of_gaussians(monkeypatch):
    monkeypatch.setattr(torch.cuda, "synchronize", lambda _: None)
    played = Played(monkeypatch)
    assert [played.iterate(step, 0) for step in range(3)] == [["done"], ["recorded", "replayed"], ["replayed"]]
    assert played.iterate(3, 0, shape=1) == ["done"]
    assert played.iterate(4, 0, shape=1) == ["recorded", "replayed"]


def test_what_had_too_little_room_is_recorded_anew(monkeypatch):
    played = Played(monkeypatch)
    for step in range(2):
        played.iterate(step, 0)
    played.replays.check()
    assert played.iterate(2, 0) == ["replayed"]
    played.replays.missing += 1
    monkeypatch.setattr(torch.cuda, "synchronize", lambda _: None)
    played.replays.check()
    assert int(played.replays.missing) == 0
    assert played.iterate(3, 0) == ["done"], "it says anew how much it needs"


def test_where_nothing_is_to_be_recorded_all_is_done(monkeypatch):
    played = Played(monkeypatch)
    played.replays.wanted = False
    assert [played.iterate(step, 0) for step in range(3)] == [["done"]] * 3


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
    monkeypatch.setattr(torch.cuda, "synchronize", lambda _: None)
    played, full = Played(monkeypatch), [False, True]
    for step in range(2):
        played.iterate(step, 0)

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
